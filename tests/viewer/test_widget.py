"""The widget of notebooks: the same requests and answers, over the notebook's channel."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import numpy as np
import pytest
from viewed_scene import SCENE

import mitsuba_fspt as fspt

pytest.importorskip("anywidget", reason="the extra 'notebook' is not installed")


@pytest.fixture
def widget(mono, monkeypatch):
    """What `fspt.view` returns in a Jupyter kernel, with the messages that it sends."""
    shell = SimpleNamespace(config={"IPKernelApp": {}})
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    widget = fspt.view(SCENE, f_number=8)
    widget.sent = []
    monkeypatch.setattr(type(widget), "send", lambda self, record, buffers=None: self.sent.append((record, buffers)))
    yield widget
    widget.close()


def test_the_widget_answers_as_the_server_does(widget):
    image = fspt.render(fspt.load(SCENE, f_number=5.6))
    for message in (
        {"kind": "hello"},
        {"kind": "picture", "number": 1, "values": {"f_number": "5.6"}},
        {"kind": "shell"},
    ):
        widget._take(widget, message, [])
    (hello, _), (picture, planes), (error, _) = widget.sent
    assert [slider["value"] for slider in hello["sliders"]] == [8, 0]
    assert picture["planes"] == ["power", "error", "coverage"]
    assert np.array_equal(np.frombuffer(planes[0], np.float32).reshape(40, 48), image.power.astype(np.float32))
    assert error["kind"] == "error"
    assert "export default" in widget._esm
    assert ".fspt" in widget._css


def test_what_is_no_scene_is_refused(mono):
    with pytest.raises(fspt.FsptError, match="to change it, it must be a file"):
        fspt.view(3, ready=print)
