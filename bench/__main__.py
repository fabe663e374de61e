"""The command `bench`, and `python -m cavbench`."""

from __future__ import annotations


def main() -> None:
    """Carry out the command line, and end the process with its exit code."""
    from cavbench.cli.ending import ended
    from cavbench.cli.main import main as command

    ended(command)


if __name__ == "__main__":
    main()
