"""A document for machines: what every one has, and the schema that ships with the package."""

from __future__ import annotations

import json
import re
import tomllib

import jsonschema
import pytest

import cavbench
from cavbench.documents import GROUP, document, schema, written
from tests.tree import FOLDERS, ROOT


def test_the_schema_is_valid_and_has_a_definition_of_every_kind_of_document() -> None:
    own = schema()
    jsonschema.Draft202012Validator.check_schema(own)
    assert set(own["properties"]["document"]["enum"]) <= set(own["$defs"])


def test_the_schema_names_every_document_that_a_command_or_report_writes_and_no_other() -> None:
    source = "\n".join(path.read_text() for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
    commands = set(re.findall(r'documents\.(?:show|document)\("(\w+)"', source))
    own = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]
    reports = set(own[GROUP])
    assert {"check", "leaderboard"} <= commands
    assert {"run", "beside"} <= reports
    assert commands | reports == set(schema()["properties"]["document"]["enum"])


def test_a_document_says_its_kind_and_versions_and_has_no_nan() -> None:
    made = document("list", {"components": []})
    jsonschema.validate(made, schema())
    assert (made["schema"], made["cavbench"]) == (1, cavbench.__version__)
    assert json.loads(written(made)) == made
    with pytest.raises(ValueError, match="JSON"):
        written({"score": float("nan")})


@pytest.mark.parametrize("name", ["leaderboard", "beside", "run", "list", "check", "audit"])
def test_a_document_without_its_content_does_not_keep_to_the_schema(name: str) -> None:
    with pytest.raises(jsonschema.ValidationError, match="is a required property"):
        jsonschema.validate(document(name, {}), schema())


def test_no_document_has_a_field_that_the_schema_does_not_know() -> None:
    with pytest.raises(jsonschema.ValidationError, match="'score'"):
        jsonschema.validate(document("list", {"components": [], "score": 1}), schema())
