"""Worlds whose traffic is driven by SUMO (libsumo 1.28, https://eclipse.dev/sumo): `pip install 'cavbench[sumo]'`."""
