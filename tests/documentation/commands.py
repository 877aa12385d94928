"""The page of all `mrasfm` subcommands, from their argument parsers."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from mrasfm_engine.cli import build_parser
from tests.documentation.tables import table

PREAMBLE = """<!-- Made from the argument parsers by make docs: change the parsers, not this page. -->

# Commands

`mrasfm COMMAND --help` prints the same on the command line.

## Exit codes

| code | meaning |
|---|---|
| 0 | done |
| 2 | the input or the drive is at fault; the message names the file, the field and the remedy |
| 130 | interrupted |
| 143 | stopped by SIGTERM |

A few commands have further codes; they are listed with the command. An interrupted reconstruction goes on from its last
finished stage when the same command runs again.

The first run on a machine, and the first run after an update, compiles the inner loops for the machine and takes
one to two minutes longer. If standard error is no terminal, stages print a plain line when they begin, when they end,
and every 30 s in between.
"""


def command_page() -> str:
    """Every subcommand with its arguments, as Markdown."""
    return PREAMBLE + "".join(_commands(build_parser(), level=2))


def _commands(parser: argparse.ArgumentParser, *, level: int) -> Iterator[str]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            helps = {choice.dest: choice.help or "" for choice in action._choices_actions}
            for name, child in action.choices.items():
                yield _command(child, summary=helps.get(name, ""), level=level)
                yield from _commands(child, level=level + 1)


def _command(parser: argparse.ArgumentParser, *, summary: str, level: int) -> str:
    description = parser.description or f"{summary[:1].upper()}{summary[1:]}."
    actions = [action for action in parser._actions if not isinstance(action, argparse._SubParsersAction)]
    actions.sort(key=lambda action: bool(action.option_strings))  # first what has no option, as in the usage
    arguments = [action for action in actions if not isinstance(action, argparse._HelpAction)]
    parts = [
        f"\n{'#' * level} {parser.prog}\n",
        f"\n{_escaped(description)}\n",
        f"\n```\n{_usage(parser, arguments)}\n```\n",
    ]
    if arguments:
        parts.append("\n" + table(["argument", "meaning"], [[f"`{_form(a)}`", _meaning(a)] for a in arguments]))
    paragraphs = (parser.epilog or "").split("\n\n")
    texts = [_escaped(" ".join(paragraph.split())) for paragraph in paragraphs if paragraph.strip()]
    parts += [f"\n{text[:1].upper()}{text[1:]}\n" for text in texts]
    return "".join(parts)


def _usage(parser: argparse.ArgumentParser, arguments: list[argparse.Action]) -> str:
    required = [_form(action) for action in arguments if action.option_strings and action.required]
    positional = [_form(action) for action in arguments if not action.option_strings]
    nested = [a.metavar for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
    options = ["[OPTIONS]"] if any(action.option_strings and not action.required for action in arguments) else []
    return " ".join(str(word) for word in [parser.prog, *positional, *required, *options, *nested])


def _form(action: argparse.Action) -> str:
    """`--out OUT`, `DRIVE`, `[SCENE ...]`."""
    value = action.metavar or ("|".join(action.choices) if action.choices else action.dest.upper())
    value = value if isinstance(value, str) else " ".join(value)
    if action.nargs == 0:
        value = ""
    elif action.nargs in ("*", "?", "+"):
        more = {"*": f"[{value} ...]", "?": f"[{value}]", "+": f"{value} [{value} ...]"}
        value = more[action.nargs]
    return " ".join(word for word in (action.option_strings[-1] if action.option_strings else "", value) if word)


def _meaning(action: argparse.Action) -> str:
    text = (action.help or "") % {**vars(action), "prog": "mrasfm"}
    has_default = isinstance(action.default, int | float | str) and action.default not in ("", argparse.SUPPRESS)
    if has_default and "default" not in text and action.nargs != 0:
        text += f" (default: {action.default})"
    return ("required: " if action.required and action.option_strings else "") + _escaped(text)


def _escaped(text: str) -> str:
    """Asterisks are no emphasis, and angle brackets no HTML."""
    return text.replace("*", "\\*").replace("<", "&lt;")
