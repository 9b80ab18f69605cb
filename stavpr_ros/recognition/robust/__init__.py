"""Mode robust: options, centering, z-normalization, hysteresis."""
