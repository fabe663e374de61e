"""The figures of the documentation, each made from the real code, weights and records: `python -m docs.figures NAME...`."""
