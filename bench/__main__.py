"""`python -m bench`: the command line."""

from cavbench.cli.ending import ended
from cavbench.cli.main import main

ended(main)
