"""Accuracy, covariance and speed of the estimator, measured: ``rs_relpose benchmark``.

`problems` and `oracle` use nothing else of the package, so that an error of the estimator cannot
hide in what it is measured against.
"""
