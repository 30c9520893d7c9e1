"""Bags through the pipeline: replay, check, unroll."""
