"""Where the cameras are: bundle adjustment with an arch of teeth as the landmarks."""
