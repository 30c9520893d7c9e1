"""What a recording is good for: one pass over a bag, a verdict and a remedy for each finding."""
