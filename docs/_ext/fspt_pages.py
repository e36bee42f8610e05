"""Directives for parts of pages that come from the code: parameters of a plugin, verbs of the command line.

{plugin} surface        description and parameters of `mitsuba_fspt/plugins/surface.py`, read from its class's docstring
{verbs}                 every verb of `fspt` with its help, arguments and options, from the app itself
"""

from __future__ import annotations

import ast
import re
from pathlib import Path

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.util.docutils import SphinxDirective

PLUGINS = Path(__file__).parents[2] / "mitsuba_fspt" / "plugins"


def docstring_of(plugin: str) -> str:
    """Docstring of the plugin's class; its module is not imported, for that needs a variant of Mitsuba."""
    tree = ast.parse((PLUGINS / f"{plugin}.py").read_text(encoding="utf-8"))
    (kind,) = (node for node in tree.body if isinstance(node, ast.ClassDef) and node.name.startswith("Fspt"))
    return ast.get_docstring(kind) or ""


def plugin_markup(plugin: str) -> str:
    """The docstring in reStructuredText of Sphinx: Mitsuba's own roles and directives are replaced."""
    text = re.sub(r"\A\.\. _[^\n]+\n\n([^\n]+)\n-+\n", "", docstring_of(plugin))  # label and title: the page has them
    table, _, rest = text.partition(".. pluginparameters::\n\n")[2].partition("\n\n")
    head = (
        ".. list-table::\n   :header-rows: 1\n   :widths: 22 16 62\n\n   * - parameter\n     - type\n     - meaning\n"
    )
    rows = []
    for line in table.strip("\n").splitlines():
        name = re.fullmatch(r" \* - (.+)", line)
        line = " * - " + ", ".join(f"``{word}``" for word in name[1].split(", ")) if name else line
        rows.append("  " + re.sub(r"\|(\w+)\|", r"\1", line))
    return f"{head}{chr(10).join(rows)}\n\n{rest}"


def verbs_markup() -> str:
    """A section of reStructuredText for each verb."""
    import typer

    from mitsuba_fspt.cli.app import app

    parts: list[str] = []

    def add(command, name: str) -> None:
        if getattr(command, "commands", None):
            for verb, inner in sorted(command.commands.items()):
                add(inner, f"{name} {verb}")
            return
        context = command.make_context(name, [], resilient_parsing=True)
        parts.append(f"{name}\n{'-' * len(name)}\n")
        parts.append("::\n\n    " + " ".join(command.get_usage(context).split()[1:]) + "\n")
        for paragraph in (command.help or "").split("\n\n"):
            parts.append(escaped(" ".join(paragraph.split())) + "\n")
        records = [parameter.get_help_record(context) for parameter in command.params if parameter.name != "help"]
        rows = "\n".join(row(*record) for record in records if record)
        if rows:
            parts.append(f".. list-table::\n   :widths: 40 60\n\n{rows}\n")

    add(typer.main.get_command(app), "fspt")
    return "\n".join(parts)


def escaped(text: str) -> str:
    """Text without characters that reStructuredText would take for markup."""
    return re.sub(r"([*`|_\\])", r"\\\1", text)


def row(name: str, meaning: str) -> str:
    return f"   * - ``{name}``\n     - {escaped(' '.join(meaning.split())) or chr(92)}"


class Generated(SphinxDirective):
    """Base of the directives: markup that is parsed as if the page contained it."""

    optional_arguments = 1

    def markup(self) -> str:
        raise NotImplementedError

    def run(self) -> list[nodes.Node]:
        lines = StringList(self.markup().splitlines(), source=self.get_source_info()[0])
        holder = nodes.section()
        holder.document = self.state.document
        from sphinx.util.nodes import nested_parse_with_titles

        nested_parse_with_titles(self.state, lines, holder)
        return holder.children


class PluginDirective(Generated):
    required_arguments, optional_arguments = 1, 0

    def markup(self) -> str:
        self.env.note_dependency(str(PLUGINS / f"{self.arguments[0]}.py"))
        return plugin_markup(self.arguments[0])


class VerbsDirective(Generated):
    def markup(self) -> str:
        return verbs_markup()


def setup(app):
    app.add_directive("plugin", PluginDirective)
    app.add_directive("verbs", VerbsDirective)
    return {"parallel_read_safe": True}
