"""`fspt view` without a browser: who may ask, what is answered, how it ends."""

from __future__ import annotations

import json
import socket
import struct
import urllib.error
import urllib.request

import numpy as np
import pytest
from small_scenes import write_ply
from viewed_scene import SCENE, interrupt, serve

import mitsuba_fspt as fspt
from mitsuba_fspt.rendering.scene_xml import read_text
from mitsuba_fspt.viewer.answers import Answers, Request, Superseded
from mitsuba_fspt.viewer.faults import in_parameters
from mitsuba_fspt.viewer.queue import RequestQueue

client = pytest.importorskip("websockets.sync.client", reason="the extra 'view' is not installed")
pytest.importorskip("starlette", reason="the extra 'view' is not installed")


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    scene = tmp_path_factory.mktemp("view") / "box.xml"
    scene.write_text(SCENE)
    process, address = serve(scene, "-D", "f_number=8")
    yield address
    code, errors = interrupt(process)
    assert (code, errors) == (0, "")


def open_page(address, origin=None):
    home = "/".join(address.split("/")[:3])
    return client.connect(address.replace("http", "ws") + "socket", origin=origin or home, max_size=None)


def receive(page):
    message = page.recv()
    length = struct.unpack_from("<I", message)[0]
    record = json.loads(message[4 : 4 + length])
    return record, np.frombuffer(message[4 + length :], np.float32)


def status_of(address):
    try:
        return urllib.request.urlopen(address).status
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


def test_the_page_needs_its_token(address):
    assert status_of(address) == 200
    assert status_of(address + "view.js") == 200
    home = "/".join(address.split("/")[:3])
    for wrong in (f"{home}/", f"{home}/view.js", f"{home}/{'x' * 24}/", f"{home}/{'x' * 24}/view.js"):
        code, line = status_of(wrong)
        assert code == 403
        assert "token" in line
    assert status_of(address + "server.py")[0] == 404
    rebound = urllib.request.Request(address, headers={"Host": "example.org"})  # a name that points to this machine
    assert status_of(rebound)[0] == 403


@pytest.mark.parametrize("fault", ["token", "origin", "none"])
def test_a_stranger_gets_no_channel(address, fault):
    """A page of another site, which the browser names as the origin, and one that guesses."""
    changed = address.rstrip("/")[:-3] + "xyz/" if fault == "token" else address
    with pytest.raises(Exception, match="403") if fault != "none" else open_page(changed) as page:
        if fault == "none":
            assert receive(page)[0]["kind"] == "hello"
        else:
            open_page(changed, "http://example.org" if fault == "origin" else None)


def test_images_are_those_of_render_and_invalid_requests_are_refused(address):
    with open_page(address) as page:
        hello, _ = receive(page)
        assert [slider["name"] for slider in hello["sliders"]] == ["f_number", "turn"]
        assert hello["sliders"][0]["value"] == 8
        page.send(json.dumps({"kind": "picture", "number": 1, "values": {"f_number": "4"}, "etendue": True}))
        record, planes = receive(page)
        image = fspt.render(fspt.load(SCENE, f_number=4))
        assert record["planes"] == ["power", "error", "coverage", "etendue"]
        for plane, wanted in zip(planes.reshape(4, 40, 48), (image.power, image.error, image.coverage), strict=False):
            assert np.array_equal(plane, wanted.astype(np.float32))
        assert record["command"].endswith("box.xml -D f_number=4 -o box.exr")
        for bad in (
            '{"kind": "picture", "values": 3}',
            "[1",
            '{"kind": "shell"}',
            '{"values": {"f_number": "0"}, "kind": "picture"}',
        ):
            page.send(bad)
            record, _ = receive(page)
            assert record["kind"] == "error"
            assert "\n" not in record["message"]
        page.send(json.dumps({"kind": "point", "number": 2, "pixel": [24, 20]}))
        assert receive(page)[0]["point"]["exitance"] == pytest.approx(2)


def test_a_port_in_use_is_one_line(run, tmp_path):
    scene = tmp_path / "box.xml"
    scene.write_text(SCENE)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        code, out, err = run("view", scene, "--no-browser", "--port", port)
    assert (code, out) == (2, "")
    assert err == f"fspt: port: {port} is in use on 127.0.0.1. Give another one, or 0 for any free one.\n"


def test_quiet_tells_the_address_where_no_browser_is_opened(run, tmp_path, monkeypatch):
    """Seen to fail: nothing on stdout, so that nobody could open the page."""
    from mitsuba_fspt.cli import view

    (tmp_path / "box.xml").write_text(SCENE)
    monkeypatch.setattr("mitsuba_fspt.viewer.view.view", lambda scene, ready, **others: ready("http://here/?token=a"))
    monkeypatch.setattr(view.webbrowser, "open", lambda address: None)
    arguments = ("view", tmp_path / "box.xml", "--quiet")
    assert run(*arguments, "--no-browser")[1].startswith("http://here/?token=a")
    assert run(*arguments)[1] == ""


@pytest.mark.parametrize("arguments", [("missing.xml",), ("box.xml", "-D", "f_number=-1"), ("box.xml", "--port", "-1")])
def test_bad_input_opens_no_page(run, tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "box.xml").write_text(SCENE)
    code, out, err = run("view", "--no-browser", *arguments)
    assert (code, out) == (2, "")
    assert err.startswith("fspt: ")
    assert err.count("\n") == 1


def test_of_requests_that_wait_the_latest_counts_and_drafts_go_first():
    queue, one, other = RequestQueue(), object(), object()
    draft, full = (Request("picture", "a", number, {}, fine=fine) for number, fine in ((1, False), (2, True)))
    queue.put(one, draft)
    queue.put(one, full)
    assert [queue.take(0), queue.take(0), queue.take(0)] == [(one, draft), (one, full), None]
    queue.check(one, full)  # goes on
    queue.put(other, draft)
    with pytest.raises(Superseded):
        queue.check(one, full)
    queue.put_back(one, full)
    assert [queue.take(0), queue.take(0), queue.take(0)] == [(other, draft), (one, full), None]
    queue.put(one, Request("picture", "a", 3, {}))
    queue.put_back(one, full)  # a newer one waits
    assert queue.take(0)[1].number == 3
    queue.put(one, full)
    queue.put(one, Request("picture", "a", 4, {}, fine=False))  # of other values: the full picture is outdated
    assert [queue.take(0)[1].number, queue.take(0)] == [4, None]
    queue.forget(one)
    queue.put_back(one, full)
    assert queue.take(0) is None


def test_the_exr_of_the_page_is_that_of_the_command_line(mono, tmp_path):
    """With all of its metadata but times; the command line leaves out values that are the scene's own."""
    (tmp_path / "box.xml").write_text(SCENE)
    answers = Answers(tmp_path / "box.xml", {})
    answer = answers.answer(Request("exr", "a", 1, {"f_number": "8", "turn": "0.0"}))
    (tmp_path / answer.record["name"]).write_bytes(answer.data[0])
    saved, image = fspt.read(tmp_path / "box.exr"), fspt.render(fspt.load(tmp_path / "box.xml", f_number=8))
    image.write(tmp_path / "other.exr")
    other = fspt.read(tmp_path / "other.exr")
    assert np.array_equal(saved.power, other.power)
    assert {k: v for k, v in saved.metadata.items() if k != "wall_time"} == {
        k: v for k, v in other.metadata.items() if k != "wall_time"
    }


def test_millimetres_of_a_crop_window_are_those_of_the_film(mono, tmp_path):
    """From the optical axis, in a draft, too. Seen to fail: from the middle of the window, 2.1 mm off."""
    window = "".join(
        f'<integer name="crop_{name}" value="{value}"/>'
        for name, value in {"offset_x": 4, "offset_y": 20, "width": 30, "height": 10}.items()
    )
    (tmp_path / "box.xml").write_text(SCENE.replace("</film>", window + "</film>"))
    answers, image = Answers(tmp_path / "box.xml", {}), fspt.render(fspt.load(tmp_path / "box.xml"))
    for fine in (False, True):
        record = answers.answer(Request("picture", "a", 1, {}, fine=fine)).record
        assert record["corner"] == pytest.approx([image.x[0], image.y[0]])


def test_a_phantom_is_shown_under_its_name_with_the_command_that_renders_it(mono, tmp_path, monkeypatch, run):
    """The text of the scene fixes what the framing chose; the command gives all of it."""
    monkeypatch.chdir(tmp_path)
    corners = [(0, -9, -9), (0, 9, -9), (0, 9, 9), (0, -9, 9)]
    write_ply(tmp_path / "p.ply", corners, [(0, 1, 2), (0, 2, 3)], vertex=[1.0] * 4)
    (tmp_path / "c.toml").write_text("[lens]\nf_number = 4\nfocus_distance = 150\nlens_diameter = 30\n")
    shown = {}
    monkeypatch.setattr("mitsuba_fspt.viewer.view.view", lambda scene, **options: shown.update(options, scene=scene))
    film = ("-D", "width=8", "-D", "height=8", "-D", "pixel_pitch=3.456")
    assert run("view", "p.ply", "--view", "30", "--camera", "c.toml", *film)[0] == 0
    answers = Answers(shown["scene"], {"view": shown["view"]}, 0, shown["origin"])
    assert answers.hello().record["scene"] == "p.ply"
    values = {"f_number": "8", "view": "30"}
    words = answers.answer(Request("picture", "a", 1, values)).record["command"].split()
    assert words[:5] == ["fspt", "render", "p.ply", "--camera", "c.toml"]
    saved = answers.answer(Request("exr", "a", 2, values))
    (tmp_path / "saved.exr").write_bytes(saved.data[0])
    assert saved.record["name"] == "p.exr"
    assert run(*words[1:-1], "again.exr")[0] == 0
    one, other = fspt.read("saved.exr"), fspt.read("again.exr")
    assert np.array_equal(one.power, other.power)
    assert one.metadata["f_number"] == 8
    assert one.metadata["scene"] == other.metadata["scene"]


def test_an_error_names_the_parameters_of_the_page(mono, tmp_path):
    """The lens's place is set by `distance`: seen to say 'to_world', which is on no page."""
    scene = SCENE.replace('<default name="turn"', '<default name="away" value="160"/><default name="turn"')
    (tmp_path / "box.xml").write_text(scene.replace('origin="160, 0, 0"', 'origin="$away, 0, 0"'))
    answers = Answers(tmp_path / "box.xml", {})
    bad = answers.answer(Request("picture", "a", 1, {"away": "60000000"})).record
    assert bad["kind"] == "error"
    assert bad["message"].endswith("Changed since the last picture: away = 60000000.")
    assert answers.answer(Request("picture", "a", 2, {"turn": "30"})).record["kind"] == "picture"
    bad = answers.answer(Request("picture", "a", 3, {"away": "0", "turn": "30"})).record["message"]
    assert bad.endswith("Changed since the last picture: away = 0.")
    xml = read_text(scene.replace("160, 0, 0", "$away, 0, 0"), {})
    line = in_parameters("fspt_lens: the lens stands inside. Move it out with 'to_world'.", xml, {"away": "1"})
    assert line == "fspt_lens: the lens stands inside. Move it out with 'away'."
