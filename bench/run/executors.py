"""The table of back ends, which stands above all that it lists."""

from __future__ import annotations

from collections.abc import Callable

from cavbench.run.executor import Executor
from cavbench.run.plan import Plan
from cavbench.run.process import cores
from cavbench.run.process_executor import ProcessExecutor
from cavbench.run.ray_executor import RayExecutor
from cavbench.run.serial_executor import SerialExecutor

EXECUTORS: dict[str, Callable[[Plan], Executor]] = {
    "serial": lambda plan: SerialExecutor(plan.limits),
    "processes": lambda plan: ProcessExecutor(plan.workers or cores(), plan.limits),
    "ray": lambda plan: RayExecutor(plan.workers, plan.limits, plan.ray_address),
}
"""Every back end by its name (`cavbench.run.options.EXECUTORS`): made for a plan, and closed by the caller."""
