"""The page of `fspt view` in a real, headless Chromium."""

from __future__ import annotations

import re
import shutil

import numpy as np
import pytest
from viewed_scene import SCENE, interrupt, serve

import mitsuba_fspt as fspt

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
if not BROWSER:
    pytest.skip("no Chromium on this system; scripts/setup-env installs Debian's", allow_module_level=True)

WAIT = 15_000  # ms


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=BROWSER, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    scene = tmp_path_factory.mktemp("view") / "box.xml"
    scene.write_text(SCENE)
    process, address = serve(scene)
    yield process, address
    if process.poll() is None:
        interrupt(process)


@pytest.fixture
def page(browser, served):
    page = browser.new_page(viewport={"width": 1000, "height": 900})
    page.faults = []
    page.on("pageerror", lambda error: page.faults.append(str(error)))
    page.goto(served[1])
    wait_for_picture(page)
    yield page
    assert page.faults == []
    page.close()


def wait_for_picture(page, more=""):
    page.wait_for_selector(f"[data-stage=fine]{more}", timeout=WAIT)


def shows(place, text):
    """Wait until an element has this text in it."""
    playwright.expect(place).to_contain_text(text, timeout=WAIT)


def set_number(page, name, value):
    """Type a value and wait for the full picture of it."""
    page.get_by_label(re.compile(rf"^{name}")).first.fill(str(value))
    shows(page.locator("code"), f"{name}={value} ")
    wait_for_picture(page)


def read_out(page, column, row):
    """Power and error [W/pixel] that the page reads out on a pixel."""
    box = page.locator("canvas[data-panel=a]").bounding_box()
    page.mouse.move(box["x"] + box["width"] * (column + 0.5) / 48, box["y"] + box["height"] * (row + 0.5) / 40)
    readout = page.locator(".readout")
    shows(readout.locator(".head"), f"Column {column}, row {row} ")
    assert readout.locator("thead th").all_inner_texts() == ["power [W/pixel]", "± error", "coverage"]
    power, error, _ = readout.locator("tbody td").all_inner_texts()
    return float(power), float(error)


def test_a_drag_moves_the_image_and_the_read_out_is_the_number_in_the_exr(page, tmp_path):
    before = read_out(page, 20, 20)
    box = page.locator('input[type=range][name="a:f_number"]').bounding_box()
    middle = box["y"] + box["height"] / 2
    shown = int(page.locator(".fspt").get_attribute("data-shown"))
    page.mouse.move(box["x"] + 0.4 * box["width"], middle)
    page.mouse.down()
    for step in range(8):
        page.mouse.move(box["x"] + (0.4 + 0.05 * step) * box["width"], middle)
        page.wait_for_timeout(30)
    page.wait_for_selector("[data-stage=draft], [data-stage=fine]")
    page.mouse.up()
    shows(page.locator("code"), "f_number=")
    wait_for_picture(page)
    assert int(page.locator(".fspt").get_attribute("data-shown")) > shown + 1
    page.wait_for_timeout(200)
    wait_for_picture(page)
    after = read_out(page, 20, 20)
    assert after != before
    with page.expect_download() as download:
        page.get_by_role("button", name="EXR", exact=True).click()
    download.value.save_as(tmp_path / "saved.exr")
    saved = fspt.read(tmp_path / "saved.exr")
    assert after == (pytest.approx(saved.power[20, 20], rel=1e-6), pytest.approx(saved.error[20, 20], rel=0.05))
    total = re.search(r"total (\S+) ± (\S+) W", page.locator("figcaption").first.inner_text())
    assert float(total[1]) == pytest.approx(saved.power.sum(), rel=1e-3, abs=0)
    assert float(total[2]) == pytest.approx(saved.error.sum(), rel=0.05, abs=0)


def test_log_scale_region_and_surface_point(page):
    bar = page.locator("canvas.bar").first
    assert float(bar.get_attribute("data-low")) == 0
    page.get_by_label("log scale").check()
    page.wait_for_selector("canvas.bar[data-log=true]")
    low, high = (float(bar.get_attribute(f"data-{end}")) for end in ("low", "high"))
    assert high / low == pytest.approx(1e3)
    image = fspt.render(fspt.load(SCENE))
    assert high == pytest.approx(float(image.power.max()), rel=1e-6)
    canvas = page.locator("canvas[data-panel=a]")
    box = canvas.bounding_box()
    canvas.click()
    shows(page.locator(".point"), "J_n = 2 W/mm²")
    page.mouse.move(box["x"] + 1, box["y"] + 1)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] - 1, box["y"] + box["height"] - 1)
    page.mouse.up()
    shows(page.locator(".region .head"), "Region of 48 × 40 pixels from column 0, row 0")
    total, error, *_, pixels = map(float, page.locator(".region tbody td").all_inner_texts())
    assert pixels == 48 * 40
    assert total == pytest.approx(image.power.sum(dtype=np.float64), rel=1e-5)
    assert error == pytest.approx(image.error.sum(dtype=np.float64), rel=0.05)


def test_the_surface_point_follows_the_lens(page):
    """The disc of a point before the plane in focus, R_b = (D/2) b v/(u p), is half as wide at twice the f-number."""
    page.locator("canvas[data-panel=a]").click()
    point = page.locator(".point:not(.old)")
    shows(point, "blur disc of radius")
    before = float(re.search(r"radius (\S+) pixels", point.inner_text())[1])
    set_number(page, "f_number", 8)
    playwright.expect(point).not_to_contain_text(f"radius {before:g} pixels", timeout=WAIT)
    after = float(re.search(r"radius (\S+) pixels", point.inner_text())[1])
    assert before / after == pytest.approx(2, rel=0.02)


def test_a_second_lens_beside_the_first(page):
    page.get_by_label("beside the first").check()
    page.locator('input[type=range][name="b:f_number"]').evaluate(
        "(node) => { node.value = Math.log(8); node.dispatchEvent(new Event('input')); }"
    )
    shows(page.locator("figcaption").nth(1), "f/8")
    wait_for_picture(page)
    page.wait_for_timeout(100)
    box = page.locator("canvas[data-panel=a]").bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    rows = page.locator(".readout tbody tr").all_inner_texts()
    found = {name: float(value) for name, value, *_ in (row.split("\t") for row in rows)}
    assert list(found) == ["lens", "second lens", "difference", "ratio"]
    assert found["ratio"] == pytest.approx(4, rel=0.01)  # the area of the pupil: f/4 against f/8
    assert found["lens"] - found["second lens"] == pytest.approx(found["difference"], rel=1e-4)


def test_two_pages_and_a_reload(page, browser, served):
    other = browser.new_page()
    other.goto(served[1])
    wait_for_picture(other)
    set_number(other, "f_number", 5.6)
    set_number(page, "turn", 30)
    assert "f_number" not in page.locator("code").inner_text()
    assert "turn" not in other.locator("code").inner_text()
    page.reload()
    wait_for_picture(page)
    assert "turn=30" in page.locator("code").inner_text()
    other.close()


def test_the_address_keeps_the_second_lens_and_the_display(page, browser):
    """All of them were forgotten at a reload, but for the sliders of the first lens."""
    page.get_by_label("log scale").check()
    page.locator("select[name=unit]").select_option("photons")
    page.get_by_label(re.compile("^wavelength")).fill("700")
    page.get_by_label(re.compile("^wavelength")).press("Enter")
    page.get_by_label("beside the first").check()
    page.locator("select[name=model-b]").select_option("pinhole")
    page.locator('input[type=range][name="b:f_number"]').evaluate(
        "(node) => { node.value = Math.log(8); node.dispatchEvent(new Event('input')); }"
    )
    shows(page.locator("figcaption").nth(1), "(pinhole): F = 50 mm, f/8")
    wait_for_picture(page)
    page.wait_for_function("location.hash.includes('b%3Af_number=8')")
    other = browser.new_page()
    other.goto(page.url)
    wait_for_picture(other)
    shows(other.locator("figcaption").nth(1), "(pinhole): F = 50 mm, f/8")
    assert other.locator("canvas.bar").first.get_attribute("data-log") == "true"
    assert other.locator("select[name=unit]").input_value() == "photons"
    assert other.get_by_label(re.compile("^wavelength")).input_value() == "700"
    other.close()


def test_a_field_shows_all_digits_and_an_emptied_one_its_value_again(page):
    field = page.get_by_label(re.compile("^f_number")).first
    narrow = field.bounding_box()["width"]
    field.fill("")
    field.press("Tab")
    assert field.input_value() == "4"
    set_number(page, "f_number", 4.0123456789)
    field.press("Tab")
    assert field.input_value() == "4.0123456789"
    assert field.bounding_box()["width"] > 1.1 * narrow
    assert field.evaluate("(node) => node.scrollWidth <= node.clientWidth")


WIDGET = """async (address) => {
    const sent = [], found = {};
    const model = { on: (event, take) => { found.take = take; }, off: () => {}, send: (record) => sent.push(record) };
    const root = document.body.appendChild(document.createElement("div"));
    const module = await import(address + "view.js");
    module.default.render({ model, el: root });
    await new Promise((done) => setTimeout(done, 50));
    const slider = { name: "f_number", value: 4, low: 1, high: 32, step: 0.06, scale: "stops", unit: "", lens: true };
    found.take({ kind: "hello", scene: "box", sliders: [slider], models: [] }, []);
    const record = { kind: "picture", slot: "a", number: sent.at(-1).number, fine: true, width: 1, height: 1,
        planes: ["power", "error", "coverage"], side: 0.5, corner: [2.5, -1], photons_per_joule_nm: 1, warnings: "",
        lens: {} };
    const view = new DataView(new Float32Array([3, 0, 1]).buffer);
    found.take(record, [view]);
    await new Promise((done) => setTimeout(done, 200));
    root.querySelector("canvas[data-panel=a]").dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowLeft" }));
    const texts = ["figcaption", ".readout .head"].map((name) => root.querySelector(name).textContent);
    return [sent.map((one) => one.kind), ...texts];
}"""


def test_the_module_is_a_widget_too(page, served):
    """anywidget calls `render` with a model that carries messages, planes as DataViews.

    The one pixel is that of a crop window. Seen to fail: at x 0 mm, y 0 mm.
    """
    kinds, caption, place = page.evaluate(WIDGET, served[1])
    assert place == "Column 0, row 0 (x 2.5 mm, y -1 mm)"
    assert kinds == ["hello", "picture", "picture"]
    assert "total 3 ± " in caption


def test_an_error_is_a_line_and_the_last_picture_stays_then_the_server_goes(page, served):
    """Last of the file: it ends the server."""
    before = read_out(page, 24, 20)
    page.get_by_label("f_number").first.fill("-2")
    line = page.get_by_role("alert")
    page.locator("select[name=model-a]").select_option("hrrt")
    shows(line, "'f_number' must be > 0")
    page.get_by_label("log scale").check()  # draws it again
    page.wait_for_selector("canvas.bar[data-log=true]")
    assert "hrrt" not in page.locator("figcaption").first.inner_text()  # the caption is that of the picture
    page.locator("select[name=model-a]").select_option("")
    assert read_out(page, 24, 20) == before
    set_number(page, "f_number", 5)
    assert line.text_content() == ""
    assert interrupt(served[0]) == (0, "")
    shows(line, "has ended")
    assert read_out(page, 24, 20)[0] < before[0]
