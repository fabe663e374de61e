"""What a recording is of, in words: its title, and the page that opens with it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping

from bench.scenarios import Cell


def title(meta: Mapping[str, object]) -> str:
    """One line: who drives or looks, under which attack, where."""
    words = [str(meta.get("victim", "policy"))]
    if meta.get("defense", "none") != "none":
        words.append(f"+ {meta['defense']}")
    words.append("without attack" if meta.get("attack", "none") == "none" else f"under {meta['attack']}")
    if "cell" in meta:
        words.append(f"· {Cell(**json.loads(str(meta['cell'])))}")
    return " ".join(words) + (f" · seed {meta['seed']}" if "seed" in meta else "")


def page(meta: Mapping[str, object], outcome: Iterable[str], *, queries: str = "") -> str:
    """A page: what came of it, then the components with their parameters, and the threat model.

    Args:
        meta: the record's identity columns.
        outcome: lines of Markdown.
        queries: what the threat model's queries are counted over; nothing is said of the threat model without it.
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
    found = json.loads(str(meta.get(f"{kind}_params") or "{}"))
    return " ".join([str(meta[kind]), *(f"`{name}={value}`" for name, value in found.items())])
