"""The glossary of the site, read from that of `bench help`: the directive `terms`."""

from __future__ import annotations

import tomllib

from docutils import nodes
from sphinx.util.docutils import SphinxDirective

from cavbench.cli.explain import GLOSSARY


class TermsDirective(SphinxDirective):
    """Every term of `bench help` in alphabetical order, each with its meaning and a link to its page.

    The content is the command line, so a reader of the plain Markdown sees what to type.
    """

    has_content = True

    def run(self) -> list[nodes.Node]:
        self.env.note_dependency(GLOSSARY)
        terms = tomllib.loads(GLOSSARY.read_text(encoding="utf-8"))
        found = nodes.definition_list()
        for name in sorted(terms, key=str.lower):
            meaning = terms[name]["meaning"].replace("<", "&lt;")
            text = self.parse_text_to_nodes(f"{meaning} [More]({terms[name]['page']}.md)")
            found += nodes.definition_list_item("", nodes.term("", name), nodes.definition("", *text))
        return [found]
