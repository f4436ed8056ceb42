"""The preview in a real browser: it loads, the filters filter, the overlays switch, the keys work."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from synthetless.dataset.palette import class_color
from synthetless.dataset.reader import read_specs
from synthetless.io.images import decode_rgb
from synthetless.preview import write_preview
from synthetless.preview.pages import write_pages
from tests.preview.chromium import console, requested
from tests.preview.conftest import HOSTILE_NAME, HOSTILE_OBJECT, images_of

OVERLAYS = (
    "visible",
    "amodal",
    "true-box",
    "true-axes",
    "canonical-box",
    "canonical-axes",
    "ids",
    "regressor",
    "margin",
)
pytest.importorskip("jinja2", reason="jinja2 is not installed")

MANY = 30_000


@pytest.fixture
def open_page(browser: Any, small_preview: Path) -> Any:
    browser.get("about:blank")
    browser.get(small_preview.as_uri())
    console(browser)
    yield browser
    assert console(browser) == []


@pytest.fixture(scope="session")
def keys(small_dataset: Path) -> list[str]:
    return [image.key for image in images_of(small_dataset)]


def test_the_gallery_loads_and_shows_every_image(browser: Any, small_preview: Path, keys: list[str]) -> None:
    browser.get("about:blank")
    console(browser)
    browser.get(small_preview.as_uri())
    assert browser.title == HOSTILE_NAME
    assert _css(browser, "h1")[0].text.split() == HOSTILE_NAME.split()
    assert [tile.get_attribute("data-key") for tile in _css(browser, ".tile")] == keys
    loaded = "return [...document.images].every(image => image.complete && image.naturalWidth > 0)"
    assert _eventually(browser, loaded)
    assert console(browser) == []


def test_filters_let_through_what_the_labels_say(open_page: Any, small_preview: Path) -> None:
    images = _index(small_preview)["images"]

    def expected(fits: Any, objects: Any = lambda n: True) -> list[str]:
        return [
            key
            for key, flat in images
            if objects(len(flat) // 4) and any(fits(*flat[i : i + 4]) for i in range(0, len(flat), 4))
        ]

    counts = sorted(len(flat) // 4 for _, flat in images)
    cases = [
        ({"class": "1"}, expected(lambda c, r, v, m: c == 1)),
        ({"regressor": "1"}, expected(lambda c, r, v, m: r == 1)),
        ({"class": "3", "regressor": "0"}, expected(lambda c, r, v, m: c == 3 and r == 0)),
        ({"visible-max": "60"}, expected(lambda c, r, v, m: v <= 600)),
        ({"class": "2", "visible-min": "99"}, expected(lambda c, r, v, m: c == 2 and v >= 990)),
        ({"margin": "20"}, expected(lambda c, r, v, m: m < 200)),
        ({"objects-min": str(counts[-1])}, expected(lambda *_: True, lambda n: n >= counts[-1])),
        ({"objects-max": "0"}, []),
    ]
    assert any(0 < len(keys) < len(images) for _, keys in cases)
    for values, keys in cases:
        open_page.execute_script("document.querySelector('#filters [type=reset]').click()")
        assert _eventually(open_page, f"return document.querySelectorAll('.tile').length === {len(images)}")
        for name, value in values.items():
            open_page.execute_script(
                "const field = document.getElementById('filters').elements[arguments[0]]; field.value = arguments[1];"
                "field.dispatchEvent(new Event('input', {bubbles: true}))",
                name,
                value,
            )
        assert [tile.get_attribute("data-key") for tile in _css(open_page, ".tile")] == keys, values
        assert _css(open_page, "#found")[0].text == f"{len(keys)} of 6 images"
        assert _css(open_page, "#nothing")[0].is_displayed() == (not keys)


def test_overlays_switch_by_mouse_and_by_key(open_page: Any, keys: list[str], tmp_path: Path) -> None:
    _open(open_page, keys[0], overlays=" ")
    bare = _screenshot(open_page, tmp_path / "bare.png")
    for number, name in enumerate(OVERLAYS, start=1):
        layer = f"#drawing [data-overlay='{name if number <= 6 else 'words'}']"
        assert not _css(open_page, layer)
        _css(open_page, f"#overlays input[name='{name}']")[0].click()
        assert _css(open_page, f"{layer} > *"), name
        drawn = _screenshot(open_page, tmp_path / f"{name}.png")
        assert np.abs(drawn.astype(int) - bare).max(axis=2).astype(bool).mean() > 0.001, name
        _press(open_page, str(number))
        assert not _css(open_page, layer)
    _press(open_page, "1", "5", "0")
    assert not _css(open_page, "#drawing [data-overlay]")


def test_poses_that_look_alike_are_drawn_faintly(
    browser: Any, judged_preview: Path, small_preview: Path, keys: list[str]
) -> None:
    browser.get(judged_preview.as_uri())
    _open(browser, keys[0], overlays=" ")
    layer, box = "#drawing [data-overlay='alike'] line", "#overlays input[name='alike']"
    assert not _css(browser, layer)
    _css(browser, box)[0].click()
    many = len(_css(browser, layer))
    told = [cell.text for cell in _css(browser, "#instances tbody td:nth-child(7)")]
    ghosts = sum(int(text.split(" of ")[0]) - 1 for text in told if text)
    assert many == 15 * ghosts > 0  # a box and three axes
    assert float(_css(browser, layer)[0].value_of_css_property("stroke-opacity")) < 0.5
    _press(browser, "a")
    assert not _css(browser, layer)
    assert console(browser) == []
    browser.get(small_preview.as_uri())
    _open(browser, keys[0])
    assert not _css(browser, box)[0].is_displayed()
    assert len(_css(browser, "#instances tbody tr:first-child td")) == 5


def test_words_are_object_regressor_and_margin(open_page: Any, small_preview: Path, keys: list[str]) -> None:
    _open(open_page, keys[0], overlays="ids regressor margin")
    words = {text.text.split(" · ")[1] for text in _css(open_page, "#drawing text")}
    assert words <= {"r0", "r1"}
    rows = open_page.execute_script(
        "return [...document.querySelectorAll('#instances tbody th')].map(th => th.textContent)"
    )
    flat = _index(small_preview)["images"][0][1]
    assert [row.split()[0] for row in rows] == [str(obj_id) for obj_id in flat[::4]]
    assert (f"1 {HOSTILE_OBJECT}" in rows) == (1 in flat[::4])


def test_views_and_neighbours_by_key(open_page: Any, keys: list[str]) -> None:
    _open(open_page, keys[2])
    for letter, view in (("d", "depth"), ("n", "normals"), ("i", "rgb")):
        _press(open_page, letter)
        href = _css(open_page, "#drawing image")[0].get_attribute("href")
        assert href.endswith(
            f"{keys[2][:6]}/rgb/{keys[2][7:]}.png" if view == "rgb" else f"images/{keys[2]}-{view}.jpg"
        )
    _press(open_page, "ArrowRight")
    assert _shows(open_page, keys[3])
    _press(open_page, "ArrowLeft", "ArrowLeft")
    assert _shows(open_page, keys[1])
    _press(open_page, "Escape")
    assert _eventually(open_page, f"return document.activeElement.dataset.key === '{keys[1]}'")
    _press(open_page, "ArrowRight", "Enter")
    assert _shows(open_page, keys[2])


def test_the_legend_names_the_dots_and_filters(open_page: Any, small_preview: Path) -> None:
    index = _index(small_preview)
    shown = open_page.execute_script(
        "return [...document.querySelectorAll('#classes button')].map(button =>"
        "[Number(button.dataset.class), button.textContent, button.querySelector('.dot').style.backgroundColor])"
    )
    assert [[obj_id, name] for obj_id, name, _ in shown] == [[each["id"], each["name"]] for each in index["classes"]]
    assert [colour for *_, colour in shown] == [f"rgb{class_color(obj_id)}" for obj_id, *_ in shown]
    dots = open_page.execute_script(
        "return [...document.querySelectorAll('.tile .dot')].map(dot => [dot.title, dot.style.backgroundColor])"
    )
    assert {tuple(dot) for dot in dots} == {(name, colour) for _, name, colour in shown}
    button = _css(open_page, "#classes button")[1]
    having = [key for key, flat in index["images"] if index["classes"][1]["id"] in flat[::4]]
    for pressed, expected in (("true", having), ("false", [key for key, _ in index["images"]])):
        button.click()
        assert button.get_attribute("aria-pressed") == pressed
        assert [tile.get_attribute("data-key") for tile in _css(open_page, ".tile")] == expected


def test_wheel_keys_drag_and_double_click_zoom(open_page: Any, keys: list[str]) -> None:
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.actions.wheel_input import ScrollOrigin

    def box() -> list[float]:
        return [float(number) for number in drawing.get_dom_attribute("viewBox").split()]

    _open(open_page, keys[0], overlays="ids")
    drawing = _css(open_page, "#drawing")[0]
    whole = [-0.5, -0.5, 128.0, 96.0]
    assert box() == whole
    size = int(drawing.size["width"])
    origin = ScrollOrigin.from_element(drawing, -size // 4, 0)
    ActionChains(open_page).scroll_from_origin(origin, 0, -500).perform()
    assert _eventually(open_page, "return document.getElementById('drawing').classList.contains('zoomed')")
    x, y, width, height = box()
    assert width == pytest.approx(32)
    assert (x + width / 4 + 0.5, y + height / 2 + 0.5) == (pytest.approx(32, abs=1), pytest.approx(48, abs=1))  # stays
    ActionChains(open_page).drag_and_drop_by_offset(drawing, -size // 2, 0).perform()
    assert box()[0] == pytest.approx(x + width / 2, abs=0.5)
    _press(open_page, "d")
    assert box()[2] == pytest.approx(32)  # the same part of another view
    _press(open_page, "f")
    assert box() == whole
    _press(open_page, "+", "+", "-")
    assert box()[2] == pytest.approx(128 / 1.5)
    ActionChains(open_page).double_click(drawing).perform()
    assert box() == whole
    ActionChains(open_page).double_click(drawing).perform()
    assert box()[2] == pytest.approx(32)
    _press(open_page, "ArrowRight")
    assert _shows(open_page, keys[1])
    assert box() == whole


def test_two_fingers_zoom(open_page: Any, keys: list[str]) -> None:
    _open(open_page, keys[0])
    drawn = _css(open_page, "#drawing")[0].rect
    x, y = drawn["x"] + drawn["width"] / 2, drawn["y"] + drawn["height"] / 2

    def touch(kind: str, apart: float) -> None:
        points = [] if kind == "touchEnd" else [{"x": x + side * apart / 2, "y": y, "id": side} for side in (-1, 1)]
        open_page.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    touch("touchStart", 60)
    for apart in (80, 100, 120):
        touch("touchMove", apart)
    touch("touchEnd", 0)
    shown = [float(number) for number in _css(open_page, "#drawing")[0].get_dom_attribute("viewBox").split()]
    assert shown == pytest.approx([31.5, 23.5, 64, 48], abs=1.5)


def test_what_is_not_drawn_or_gone_is_told(browser: Any, small_dataset: Path, tmp_path: Path) -> None:
    root = shutil.copytree(small_dataset, tmp_path / "z")
    page, image = write_preview(root), images_of(root)[0]
    picture = image.scene.find_rgb(image.labels.im_id)
    assert picture is not None
    picture.unlink()
    (page.parent / f"thumbnails/{image.key}.jpg").unlink()
    (page.parent / f"data/{images_of(root)[1].key}.js").unlink()
    browser.get("about:blank")
    browser.get(page.as_uri())
    assert _eventually(browser, f"return document.querySelector('[data-key=\"{image.key}\"].undrawn') !== null")
    _open(browser, image.key)
    assert _eventually(browser, "return document.getElementById('legend').textContent.includes('--copy')")
    browser.execute_script("synthetless.change(arguments[0])", {"image": images_of(root)[1].key})
    assert _eventually(browser, "return document.getElementById('legend').textContent.includes('load this page again')")
    console(browser)  # the files that are missing


def test_the_recorded_scene_is_told(open_page: Any, small_dataset: Path) -> None:
    image = images_of(small_dataset)[4]
    _open(open_page, image.key)
    told = _css(open_page, "#sections")[0].text
    recorded = read_specs(image.scene)[image.labels.im_id]
    assert f"{recorded.scene.light.elevation_deg:.1f}°" in told
    assert f"{recorded.scene.views[recorded.view].distance_m:.3f} m" in told
    assert f"{recorded.scene.plane.texture.family}, seed {recorded.scene.plane.texture.seed}" in told


def test_the_statistics_load_and_every_plot_is_there(open_page: Any) -> None:
    _css(open_page, "a[href='statistics.html']")[0].click()
    assert _eventually(open_page, "return document.querySelectorAll('figure img').length > 20")
    open_page.execute_script("for (const image of document.images) image.loading = 'eager'")
    assert _eventually(
        open_page, "return [...document.images].every(image => image.complete && image.naturalWidth > 0)"
    )
    assert _css(open_page, "h1")[0].text.split() == HOSTILE_NAME.split()
    classes = _css(open_page, "#each-class")[0]
    assert classes.get_dom_attribute("open") is None  # six images say little of a class
    assert HOSTILE_OBJECT.split()[0] in classes.get_property("textContent")
    links = [link.get_dom_attribute("href") for link in _css(open_page, ".contents a")]
    assert links[-1] == "#each-class" and all(_css(open_page, link) for link in links)


def test_nothing_asks_the_network(open_page: Any, keys: list[str]) -> None:
    requested(open_page)
    open_page.refresh()
    _open(open_page, keys[1])
    asked = requested(open_page)
    assert any(name.endswith(f"data/{keys[1]}.js") for name in asked)
    assert all(name.startswith(("file:", "data:")) for name in asked)


def test_thirty_thousand_images_stay_usable(browser: Any, tmp_path: Path) -> None:
    """The pages over an index of a whole dataset; only the index is made, nothing else grows with it."""
    rng = np.random.default_rng(3)
    images = []
    for number in range(MANY):
        count = int(rng.integers(1, 10))
        numbers = np.stack(
            [
                rng.integers(1, 31, count),
                rng.integers(0, 4, count),
                rng.integers(0, 1001, count),
                rng.integers(0, 1800, count),
            ]
        )
        images.append([f"{1 + number // 1000:06d}/{number % 1000:06d}", numbers.T.ravel().tolist()])
    index = {"images": images, "classes": [{"id": i, "name": str(i), "colour": "red"} for i in range(1, 31)]}
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "index.js").write_text(f"synthetless.index = {json.dumps(index)};")
    write_pages(tmp_path, "many", "train_synthetless", MANY)
    browser.get((tmp_path / "index.html").as_uri())
    assert _css(browser, "#found")[0].text == "30,000 of 30,000 images"
    assert len(_css(browser, ".tile")) == 60
    browser.get((tmp_path / "index.html").as_uri() + "#class=7&regressor=2&visible-max=10&page=2&size=30")
    browser.refresh()
    fits = [k for k, f in images if any(f[i : i + 2] == [7, 2] and f[i + 2] <= 100 for i in range(0, len(f), 4))]
    assert len(fits) > 30
    assert [tile.get_attribute("data-key") for tile in _css(browser, ".tile")] == fits[30:60]
    longest = browser.execute_script(
        "let most = 0; for (let i = 1; i < 10; i++) { const start = performance.now();"
        "synthetless.change({class: i}); most = Math.max(most, performance.now() - start); } return most"
    )
    print(f"filtering 30,000 images took at most {longest:.0f} ms")
    console(browser)  # thumbnails that were not made


def _css(driver: Any, selector: str) -> list[Any]:
    found: list[Any] = driver.find_elements("css selector", selector)
    return found


def _open(driver: Any, key: str, **state: str) -> None:
    driver.execute_script("synthetless.change(arguments[0])", {"image": key, **state})
    assert _eventually(driver, "return document.querySelectorAll('#sections section').length > 0")


def _shows(driver: Any, key: str) -> bool:
    return _eventually(driver, f"return document.getElementById('image-name').textContent === '{key}'")


def _press(driver: Any, *keys: str) -> None:
    from selenium.webdriver.common.keys import Keys

    names = {"ArrowLeft": Keys.ARROW_LEFT, "ArrowRight": Keys.ARROW_RIGHT, "Escape": Keys.ESCAPE, "Enter": Keys.ENTER}
    for key in keys:
        driver.switch_to.active_element.send_keys(names.get(key, key))


def _eventually(driver: Any, script: str) -> bool:
    from selenium.webdriver.support.wait import WebDriverWait

    return bool(WebDriverWait(driver, 20, 0.05).until(lambda d: d.execute_script(script)))


def _screenshot(driver: Any, path: Path) -> np.ndarray:
    """The drawing, once its picture is there."""
    driver.execute_script("scrollTo(0, 0); document.activeElement.blur()")
    content = _css(driver, "#drawing")[0].screenshot_as_png
    path.write_bytes(content)
    return decode_rgb(content)


def _index(page: Path) -> dict[str, Any]:
    text = (page.parent / "data" / "index.js").read_text()
    content: dict[str, Any] = json.loads(re.sub(r"^synthetless.index = |;\n$", "", text))
    return content
