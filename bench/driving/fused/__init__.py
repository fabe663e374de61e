"""Small networks as compiled kernels."""
