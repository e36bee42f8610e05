"""The live view as a widget of notebooks. It runs the script of the page; messages go through the notebook's kernel."""

from __future__ import annotations

from importlib.resources import files
from typing import Any

import anywidget
import traitlets

from ..runtime.errors import ViewerError
from .answers import Answer, Answers, Request


class ViewWidget(anywidget.AnyWidget):
    """Shows `answers`' scene; requests come as messages and are answered one after the other in the kernel."""

    _esm = (files(__package__) / "page" / "view.js").read_text(encoding="utf-8")
    _css = (files(__package__) / "page" / "view.css").read_text(encoding="utf-8")
    scene = traitlets.Unicode().tag(sync=True)

    def __init__(self, answers: Answers) -> None:
        super().__init__(scene=answers.hello().record["scene"])
        self._answers = answers
        self.on_msg(self._take)

    def _take(self, _: object, message: Any, __: object) -> None:
        """Answer one message of the page."""
        if message == {"kind": "hello"}:
            found = self._answers.hello()
        else:
            try:
                found = self._answers.answer(Request.read(message))
            except ViewerError as error:
                found = Answer({"kind": "error", "slot": "a", "message": str(error)})
        self.send(found.record, buffers=found.data)


def widget(answers: Answers) -> ViewWidget:
    """Widget of a scene."""
    return ViewWidget(answers)
