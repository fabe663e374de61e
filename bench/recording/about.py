"""The description of a recording: its title and its "About" page."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping

from cavbench.scenarios import Cell


def title(meta: Mapping[str, object]) -> str:
    """One line: victim, defence, attack, cell and seed."""
    parts = [str(meta.get("victim", "policy"))]
    if meta.get("defense", "none") != "none":
        parts.append(f"+ {meta['defense']}")
    parts.append("without attack" if meta.get("attack", "none") == "none" else f"under {meta['attack']}")
    if "cell" in meta:
        parts.append(f"· {Cell(**json.loads(str(meta['cell'])))}")
    return " ".join(parts) + (f" · seed {meta['seed']}" if "seed" in meta else "")


def page(meta: Mapping[str, object], outcome: Iterable[str], *, queries: str = "") -> str:
    """A Markdown page: the outcome, the components with their parameters, and the threat model.

    Args:
        meta: the record's identity columns.
        outcome: lines of Markdown.
        queries: unit of the query budget, for instance "per step"; without it the threat model is left out.
    """
    lines = [f"### {title(meta)}", "", *outcome, "", "---", ""]
    lines += [f"- **{kind}** {_component(meta, kind)}" for kind in ("victim", "defense", "attack") if kind in meta]
    if queries and "threat_norm" in meta:
        lines.append(
            f"- **threat model** {meta['threat_norm']} {meta['threat_budget']}, access {meta.get('threat_access', '?')}, "
            f"at most {meta.get('threat_queries', '?')} queries {queries}"
        )
    if "training_seed" in meta:
        lines.append(f"- **training seed** {meta['training_seed']}")
    return "\n".join(lines)


def _component(meta: Mapping[str, object], kind: str) -> str:
    parameters = json.loads(str(meta.get(f"{kind}_params") or "{}"))
    return " ".join([str(meta[kind]), *(f"`{name}={value}`" for name, value in parameters.items())])
