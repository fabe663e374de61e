"""The figures of the documentation, made from the project's code, weights and records: `python -m docs.figures NAME...`."""
