#!/usr/bin/env bash
# One guesses: a value means the same when it is typed (episodes=010) and when it stands in the configuration file (episodes: 010).
# What happens: the file is read as YAML 1.1, words have Hydra's own grammar. 010 is 8 in the file and the text 010 as a word, 0x10 is 16,
# 1:30 is 90, on and no are booleans in the file only, nan and inf are numbers as words only.
# Versions: hydra-core 1.3.8, omegaconf 2.3.1. Source: 60 values, typed and in a file.
source "$(dirname "$0")/fresh.sh"
fresh hydra-core==1.3.8 omegaconf==2.3.1
see <<'P'
from importlib.metadata import version

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

EXPECTED = {"010": ("010", 8), "0x10": ("0x10", 16), "1:30": ("1:30", 90), "on": ("on", True), "no": ("no", False), "inf": (float("inf"), "inf"),
            "1_000": (1000, 1000), "1e3": (1000.0, 1000.0), "true": (True, True)}
parser = OverridesParser.create()
seen = {text: (parser.parse_override(f"x={text}").value(), OmegaConf.create(f"x: {text}").x) for text in EXPECTED}
print(f"hydra-core {version('hydra-core')}, omegaconf {version('omegaconf')}, (as a word, in a file): {seen}")
raise SystemExit(seen != EXPECTED)
P
