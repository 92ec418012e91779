"""A differentiable vertex model of epithelial tissue."""
