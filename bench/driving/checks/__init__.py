"""The kit of the driving track, for `bench check` and `bench new`."""

from __future__ import annotations

from collections.abc import Iterator

from cavbench.checks.check import NotApplicableError, Subject, Suite
from cavbench.checks.kits import Home, Kit, Start


def _attack(subject: Subject) -> Iterator[Suite]:
    from cavbench.driving import DrivingAttack
    from cavbench.driving.checks.attack import AttackSuite
    from cavbench.driving.checks.attack_memory import AttackMemorySuite

    if not isinstance(subject.component, DrivingAttack):
        raise NotApplicableError("it is not a DrivingAttack: it does not change observations")
    yield AttackSuite(subject)
    yield AttackMemorySuite(subject)


def _policy(subject: Subject) -> Iterator[Suite]:
    from cavbench.driving.checks.policy import PolicySuite
    from cavbench.driving.checks.policy_memory import PolicyMemorySuite

    yield PolicySuite(subject)
    yield PolicyMemorySuite(subject)


def _world(subject: Subject) -> Iterator[Suite]:
    from cavbench.driving.checks.world import WorldSuite

    yield WorldSuite(subject)


ROAD = "lanes=3 density=1 weather=clear episodes=20"
KIT = Kit(
    suites={"attack": _attack, "defense": _policy, "victim": _policy, "world": _world},
    starts={
        "attack": Start(run=f"bench run attack={{name}} attack.strength=2 {ROAD}", setting="attack.strength=2"),
        "defense": Start(run=f"bench run attack=noise,pgd defense={{name}} {ROAD}", setting="defense.step_size=0.05"),
        "victim": Start(run=f"bench run attack=noise,pgd victim={{name}} {ROAD}", setting="victim.gap_m=60"),
        "world": Start(
            run="bench run world={name} victim=random attack=none gap=20 braking=2 episodes=20",
            setting="world.max_steps=100",
        ),
    },
    package="cavbench.driving.checks",
    homes={
        "attack": Home(folder="attacks/driving", package="cavbench.attacks.driving", tests="tests/attacks/driving"),
        "defense": Home(folder="defenses/driving", package="cavbench.defenses.driving", tests="tests/defenses/driving"),
        "victim": Home(
            folder="bench/driving/victims", package="cavbench.driving.victims", tests="tests/driving/victims"
        ),
    },
)
