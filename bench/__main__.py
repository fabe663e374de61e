"""`python -m bench`: the command line."""

from bench.cli.ending import ended
from bench.cli.main import main

ended(main)
