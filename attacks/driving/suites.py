"""The suites of attacks on driving policies; the lists are in the TOML files of this folder."""

from __future__ import annotations

from pathlib import Path

from cavbench.core.suites import Suite

STANDARD_2 = Suite.read(Path(__file__).with_name("standard-2.toml"))
FAULTS_1 = Suite.read(Path(__file__).with_name("faults-1.toml"))
FAULTS_2 = Suite.read(Path(__file__).with_name("faults-2.toml"))
WORLDS_2 = Suite.read(Path(__file__).with_name("worlds-2.toml"))
MESSAGES_1 = Suite.read(Path(__file__).with_name("messages-1.toml"))
