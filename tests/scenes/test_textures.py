"""The plane's textures: seamless, varied, repeatable pictures, and photographs read with care."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.distance import pdist, squareform

from synthetless.scenes.textures import (
    FAMILIES,
    PhotoTexture,
    ProceduralTexture,
    list_photos,
    load_photo,
    procedural_image,
    sample_texture,
    seamless,
    texture_from_json,
)
from synthetless.scenes.textures.layouts import courses, herringbone, hexagons, voronoi
from synthetless.scenes.textures.noise import coordinates, spectral_noise

SIZE_PX = 192
SEEDS = tuple(1000 * k + 7 for k in range(12))
LUMA = np.array([0.2126, 0.7152, 0.0722])

Pictures = dict[str, list[NDArray[np.uint8]]]


@pytest.fixture(scope="module")
def pictures() -> Pictures:
    return {f: [procedural_image(ProceduralTexture(f, s), SIZE_PX) for s in SEEDS] for f in FAMILIES}


def steps_between_lines(picture: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(2, size) mean step from every row (column) to the one before it; the first is across the border."""
    image = picture.astype(np.float64)
    return np.stack([np.abs(image - np.roll(image, 1, axis)).mean(axis=(1 - axis, 2)) for axis in (0, 1)])


def seam_rank(pictures: list[NDArray[np.uint8]]) -> float:
    """How far the step across the border stands out from the steps beside it, compared with all other places.

    The share of places that stand out less, the worse of both directions, averaged over the pictures: 2/3 is
    expected of a border like any other place, 1 of a seam.
    """
    ranks = []
    for picture in pictures:
        steps = steps_between_lines(picture)
        excess = steps - (np.roll(steps, 1, axis=1) + np.roll(steps, -1, axis=1)) / 2
        ranks.append((excess[:, 1:] < excess[:, :1]).mean(axis=1).max())
    return float(np.mean(ranks))


# --- procedural families ---


def test_there_are_many_families() -> None:
    assert len(FAMILIES) >= 16 and len(set(FAMILIES)) == len(FAMILIES)


@pytest.mark.parametrize("family", FAMILIES)
def test_pictures_are_neither_black_nor_white_and_show_contrast(family: str, pictures: Pictures) -> None:
    for picture in pictures[family]:
        assert picture.shape == (SIZE_PX, SIZE_PX, 3) and picture.dtype == np.uint8
        rgb = picture / 255
        assert 0.08 < float((rgb @ LUMA).mean()) < 0.85
        assert float(np.sqrt(np.mean((rgb - rgb.mean(axis=(0, 1))) ** 2))) > 0.035


@pytest.mark.parametrize("family", FAMILIES)
def test_pictures_continue_over_their_borders(family: str, pictures: Pictures) -> None:
    for picture in pictures[family]:
        for steps in steps_between_lines(picture):
            assert steps[0] <= 1.2 * steps[1:].max()
    assert seam_rank(pictures[family]) < 0.83
    cropped = [picture[:150, :150] for picture in pictures[family]]
    assert seam_rank(cropped) > 0.83  # the same measure sees a seam where there is one


@pytest.mark.parametrize("family", FAMILIES)
def test_the_same_texture_gives_the_same_bytes(family: str, pictures: Pictures) -> None:
    again = procedural_image(ProceduralTexture(family, SEEDS[3]), SIZE_PX)
    assert again.tobytes() == pictures[family][3].tobytes()


def test_one_thread_or_many_give_the_same_bytes(pictures: Pictures) -> None:
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1 if threads > 1 else 4)
    try:
        for family in FAMILIES:
            assert np.array_equal(procedural_image(ProceduralTexture(family, SEEDS[0]), SIZE_PX), pictures[family][0])
    finally:
        cv2.setNumThreads(threads)


def test_every_seed_and_family_gives_another_picture(pictures: Pictures) -> None:
    small = np.stack([cv2.resize(p, (16, 16), interpolation=cv2.INTER_AREA) for f in FAMILIES for p in pictures[f]])
    flat = small.reshape(len(small), -1).astype(np.float64)
    apart = squareform(pdist(flat, "cityblock") / flat.shape[1])
    np.fill_diagonal(apart, np.inf)
    assert apart.min() > 1.0
    assert np.median(apart.min(axis=1)) > 8.0


@pytest.mark.parametrize("family", FAMILIES)
def test_seeds_of_a_family_differ_in_colour(family: str, pictures: Pictures) -> None:
    means = np.stack([picture.mean(axis=(0, 1)) for picture in pictures[family]])
    assert float(np.linalg.norm(means.std(axis=0))) > 15


def test_backgrounds_are_strongly_coloured_too(pictures: Pictures) -> None:
    colours = np.stack([p.mean(axis=(0, 1)) for f in FAMILIES for p in pictures[f]])
    saturation = np.ptp(colours, axis=1)
    assert np.quantile(saturation, 0.9) > 80 and np.quantile(saturation, 0.1) < 25
    strongest = colours.argmax(axis=1)[saturation > 40]
    assert set(strongest) == {0, 1, 2}


@pytest.mark.parametrize("family", ["wood_planks", "marble", "stripes", "hexagon_tiles", "shapes"])
def test_a_seed_means_the_same_pattern_at_every_size(family: str) -> None:
    small = procedural_image(ProceduralTexture(family, 5), 256)
    large = cv2.resize(procedural_image(ProceduralTexture(family, 5), 768), (256, 256), interpolation=cv2.INTER_AREA)
    correlation = np.corrcoef(cv2.blur(small, (9, 9)).ravel(), cv2.blur(large, (9, 9)).ravel())[0, 1]
    assert correlation > 0.9


def test_too_small_a_picture_is_refused() -> None:
    with pytest.raises(ValueError, match="texture size 3 px: must be at least 64"):
        procedural_image(ProceduralTexture(FAMILIES[0], 1), 3)


# --- the tools ---


@given(seed=st.integers(0, 2**32), slope=st.floats(0, 2.5), stretch=st.floats(1, 60), angle=st.floats(0, 180))
def test_noise_is_periodic_with_mean_0_and_variance_1(seed: int, slope: float, stretch: float, angle: float) -> None:
    noise = spectral_noise(np.random.default_rng(seed), 64, slope=slope, stretch=stretch, angle_deg=angle, high=8)
    assert abs(float(noise.mean())) < 1e-4 and abs(float(noise.std()) - 1) < 1e-4
    steps = np.abs(noise - np.roll(noise, 1, axis=0))
    assert float(steps[0].max()) <= 2.5 * float(steps[1:].max())


@given(seed=st.integers(0, 2**32))
def test_layouts_use_every_cell_and_measure_its_border(seed: int) -> None:
    rng = np.random.default_rng(seed)
    u, v = coordinates(rng, 192)
    rows, columns = int(rng.integers(2, 9)), int(rng.integers(2, 9))
    bond = courses(u, v, rows, columns, rng.random(rows))
    for cells, cell_area in (
        (bond, 1 / bond.count),
        (herringbone(u, v, 1, 3)[0], 3 / 36),
        (hexagons(u, v, columns), 1 / (columns * max(2, 2 * round(columns / np.sqrt(3))))),
    ):
        area = np.bincount(cells.labels.ravel(), minlength=cells.count) / cells.labels.size
        assert np.allclose(area[area > 0], cell_area, rtol=0.35)
        assert abs(area[area > 0].mean() - cell_area) < 1e-9  # as many cells as fit, each label one cell
        assert float(cells.edge.min()) < 1.5 / 192 and float(cells.edge.min()) >= -1e-5


def test_voronoi_cells_hold_the_pixels_nearest_to_their_points() -> None:
    cells = voronoi(np.random.default_rng(3), 128, 6)
    twice = np.tile(cells.labels, (2, 2))
    for label in np.unique(cells.labels):
        parts, _ = cv2.connectedComponents((twice == label).astype(np.uint8)[32:224, 32:224])
        assert parts - 1 <= 4  # one convex cell per copy, none torn at the border
    change = cells.labels != np.roll(cells.labels, 1, axis=1)
    assert float(cells.edge[change].max()) == pytest.approx(0.5 / 128)


# --- the record ---


@given(index=st.integers(0, len(FAMILIES) - 1), seed=st.integers(0, 2**63 - 1))
def test_json_returns_the_texture(index: int, seed: int) -> None:
    texture = ProceduralTexture(FAMILIES[index], seed)
    assert texture_from_json(json.loads(json.dumps(texture.to_json()))) == texture


@given(file=st.text(min_size=1))
def test_json_returns_the_photograph(file: str) -> None:
    assert texture_from_json(json.loads(json.dumps(PhotoTexture(file).to_json()))) == PhotoTexture(file)


@pytest.mark.parametrize(
    ("record", "message"),
    [
        ({"family": "marbel", "seed": 1}, "no texture family 'marbel': did you mean marble?"),
        ({"family": "marble", "seed": -1}, "texture seed -1: must be an integer"),
        ({"family": "marble", "seed": 2**63}, "must be an integer"),
        ({"family": "marble", "seed": 0.5}, "texture seed 0.5"),
        ({"family": "marble"}, "not a texture"),
        ({"file": 3}, "not a texture"),
        ({}, "not a texture"),
    ],
)
def test_a_wrong_record_is_refused(record: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=r"^[^\n]*$") as error:
        texture_from_json(record)
    assert message in str(error.value)


def test_sampling_is_uniform_over_families_and_repeatable() -> None:
    def sample(seed: int) -> list[object]:
        rng = np.random.default_rng(seed)
        return [sample_texture(rng) for _ in range(2700)]

    first = sample(1)
    assert first == sample(1) and first != sample(2)
    drawn = [t for t in first if isinstance(t, ProceduralTexture)]
    assert len({t.seed for t in drawn}) == len(drawn) == 2700
    counts = [sum(t.family == family for t in drawn) for family in FAMILIES]
    assert min(counts) > 55 and max(counts) < 160  # 100 expected, 10 the standard deviation


def test_photographs_are_preferred_and_families_can_be_chosen() -> None:
    rng = np.random.default_rng(0)
    photos = ("a.jpg", "b/c.png")
    assert {sample_texture(rng, photos) for _ in range(50)} == {PhotoTexture(p) for p in photos}
    chosen = {sample_texture(rng, families=("cork",)) for _ in range(5)}
    assert all(isinstance(t, ProceduralTexture) and t.family == "cork" for t in chosen)
    with pytest.raises(ValueError, match="at least one"):
        sample_texture(rng, families=())


# --- photographs ---


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Noise as JPEG and PNG, in folders, with things beside them that are no images."""
    (tmp_path / "deep" / "er").mkdir(parents=True)
    noise = np.random.default_rng(0).integers(0, 256, (60, 90, 3), dtype=np.uint8)
    for name in ("b.png", "a.JPG", "deep/er/c.jpeg", ".hidden.png"):
        cv2.imwrite(str(tmp_path / name), noise)
    (tmp_path / "readme.txt").write_text("none")
    return tmp_path


def test_photographs_are_found_below_the_folder_in_order(folder: Path) -> None:
    assert list_photos(folder) == ("a.JPG", "b.png", "deep/er/c.jpeg")


def test_a_folder_without_photographs_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("none")
    with pytest.raises(ValueError, match=r"^textures folder .*: no \.jpg.*$"):
        list_photos(tmp_path)
    for missing in (tmp_path / "nowhere", tmp_path / "notes.txt"):
        with pytest.raises(ValueError, match=r"^textures folder .*: not a folder.*$"):
            list_photos(missing)


def test_colours_come_as_rgb(tmp_path: Path) -> None:
    red = np.zeros((8, 8, 3), np.uint8)
    red[..., 2] = 200  # OpenCV writes BGR
    cv2.imwrite(str(tmp_path / "red.png"), red)
    assert load_photo(tmp_path, "red.png")[3, 3].tolist() == [200, 0, 0]


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("depth", [np.uint8, np.uint16])
def test_grey_alpha_and_16_bit_become_8_bit_rgb(tmp_path: Path, channels: int, depth: type[np.generic]) -> None:
    top = 255 if depth is np.uint8 else 65535
    ramp = np.tile(np.linspace(0, top, 64), (5, 1)).round().astype(depth)
    cv2.imwrite(str(tmp_path / "ramp.png"), np.dstack([ramp] * channels))
    image = load_photo(tmp_path, "ramp.png")
    assert image.shape == (5, 64, 3) and image.dtype == np.uint8
    assert np.abs(image[2].astype(float) - np.linspace(0, 255, 64)[:, None]).max() <= 1.5


def test_large_photographs_are_reduced(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "large.png"), np.full((50, 400, 3), 90, np.uint8))
    assert load_photo(tmp_path, "large.png", max_size_px=100).shape == (12, 100, 3)
    assert load_photo(tmp_path, "large.png", max_size_px=400).shape == (50, 400, 3)


@pytest.mark.parametrize("name", ["a.JPG", "b.png"])
@pytest.mark.parametrize("damage", ["empty", "half", "all but the end", "text", "header"])
def test_a_broken_photograph_is_named_in_one_line(folder: Path, name: str, damage: str) -> None:
    path = folder / name
    data = path.read_bytes()
    damaged = {
        "empty": b"",
        "half": data[: len(data) // 2],
        "all but the end": data[:-12],
        "text": b"not an image at all " * 40,
        "header": data[:4] + bytes(600) + data[604:],
    }
    path.write_bytes(damaged[damage])
    with pytest.raises(ValueError, match=r"^[^\n]*$") as error:
        load_photo(folder, name)
    assert str(path) in str(error.value)


def test_a_missing_photograph_is_named(folder: Path) -> None:
    with pytest.raises(ValueError, match=r"gone\.jpg: cannot be read"):
        load_photo(folder, "gone.jpg")


def test_a_thumbnail_in_the_header_does_not_hide_a_cut(folder: Path) -> None:
    """Cameras put a whole small JPEG before the picture's own data."""
    data = (folder / "a.JPG").read_bytes()
    thumbnail = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
    app1 = b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail
    whole = data[:2] + app1 + data[2:]
    (folder / "camera.jpg").write_bytes(whole)
    assert load_photo(folder, "camera.jpg").shape == (60, 90, 3)
    (folder / "camera.jpg").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="cut short"):
        load_photo(folder, "camera.jpg")


def test_real_photographs_load(photo_textures: Path) -> None:
    names = list_photos(photo_textures)
    assert len(names) >= 1
    for name in names:
        image = load_photo(photo_textures, name, max_size_px=512)
        assert image.ndim == 3 and max(image.shape) <= 512 and image.std() > 1


# --- photographs made seamless ---


def photograph(kind: str) -> NDArray[np.uint8]:
    """Noise of every scale, or bricks, both brighter on the right and at the bottom."""
    row, column = np.mgrid[:360, :360].astype(np.float64)
    rng = np.random.default_rng(3)
    if kind == "noise":
        pattern = sum(
            cv2.GaussianBlur(rng.standard_normal((360, 360)), (0, 0), sigma) * sigma for sigma in (1.0, 3.0, 9.0)
        )
        pattern = 20 * np.asarray(pattern)
    else:
        offset = 20 * (row // 25 % 2)
        pattern = -60.0 * ((row % 25 < 3) | ((column + offset) % 40 < 3)) + rng.standard_normal((360, 360))
    grey = 110 + pattern + 0.12 * column + 0.1 * row
    return np.repeat(np.clip(grey, 0, 255)[..., None], 3, axis=2).astype(np.uint8)


@pytest.mark.parametrize("kind", ["noise", "bricks"])
def test_a_photograph_is_made_seamless(kind: str) -> None:
    """The step across the border, with the gradient of the light evened out, is like the steps inside."""
    before, tile = photograph(kind), seamless(photograph(kind))
    assert tile.shape == (288, 288, 3)
    for axis in (0, 1):
        steps = steps_between_lines(tile)[axis]
        assert steps[0] <= np.quantile(steps[1:], 0.98) * 1.05
        assert steps[0] < 0.7 * steps_between_lines(before)[axis][0]


@pytest.mark.parametrize("kind", ["noise", "bricks"])
def test_a_seamless_photograph_is_that_photograph_without_mirrors(kind: str) -> None:
    before, tile = photograph(kind), seamless(photograph(kind))
    assert (tile[72:, 72:] == before[72:288, 72:288]).all(), "beyond the overlap nothing changes"
    twice = np.tile(tile, (1, 2, 1)).astype(np.float64)[..., 0]
    twice -= cv2.blur(twice, (61, 61))
    for at in (144, 288, 432):
        half = twice[:, at - 80 : at + 80]
        similarity = np.corrcoef(half.ravel(), half[:, ::-1].ravel())[0, 1]
        assert similarity < 0.75, "mirrored"


def test_the_cut_lies_where_the_borders_differ_least() -> None:
    """Where the overlap agrees along one line only, the seam is on it and nothing of the edges is blended."""
    from synthetless.scenes.textures.seamless import _cheapest_path

    cost = np.full((50, 40), 9.0, dtype=np.float32)
    line = (20 + 5 * np.sin(np.arange(50) / 49 * 2 * np.pi)).round().astype(int)
    cost[np.arange(50), line] = 0
    assert (_cheapest_path(cost, is_closed=True) == line).all()
    free = _cheapest_path(np.random.default_rng(0).random((50, 40), dtype=np.float32), is_closed=True)
    assert free[0] == free[-1]
    assert np.abs(np.diff(free)).max() <= 1


@pytest.mark.parametrize("shape", [(1, 1, 3), (15, 400, 3), (16, 16, 3), (17, 300, 3), (40, 2048, 3)])
def test_photographs_of_any_size_are_taken(shape: tuple[int, int, int]) -> None:
    pixels = np.random.default_rng(1).integers(0, 256, shape, dtype=np.uint8)
    tile = seamless(pixels)
    assert tile.dtype == np.uint8
    assert min(tile.shape) >= 1
    assert (tile == seamless(pixels)).all()
