"""What a fit is given: photographs to come near, and Gaussians to start with."""
