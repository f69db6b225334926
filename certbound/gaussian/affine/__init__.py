"""Exit probabilities of affine models with additive Gaussian noise, at any stiffness and horizon."""
