"""The driving world: highway-env, exactly, batched."""
