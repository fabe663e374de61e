"""cavbench: how much does this attack hurt this defence of an automated vehicle?"""

__version__ = "0.1.0"
