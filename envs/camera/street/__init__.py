"""The procedural street: meshes, textures and light for the path tracer, all from a seed, without external assets."""
