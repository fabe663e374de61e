"""cavbench: how much does this attack hurt this defence of an automated vehicle?"""

from bench import shadow

__version__ = "0.1.0"

shadow.check()
