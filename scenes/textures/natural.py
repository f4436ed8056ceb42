"""Painters of grown, cast and rolled materials: wood, stone, metal, leather.

A painter takes a random generator and a size in pixels and returns a seamless (size, size, 3) sRGB image in 0..1.
"""

from __future__ import annotations

import numpy as np

from synthetless.scenes.textures.colour import Colours, Image, from_lch, lit, mix, palette, ramp, tones
from synthetless.scenes.textures.layouts import courses, herringbone, shuffled, voronoi
from synthetless.scenes.textures.noise import (
    Field,
    blur,
    coordinates,
    normalised,
    smoothstep,
    spectral_noise,
    warp,
)


def _wood_tones(rng: np.random.Generator, n: int) -> Colours:
    return tones(rng, n, lightness=(22, 84), chroma=(12, 42), hue_deg=(48, 78))


def _stone_tones(rng: np.random.Generator, n: int, dyed: float = 0.2) -> Colours:
    return tones(rng, n, lightness=(18, 92), chroma=(0, 14), hue_deg=(40, 110), dyed=dyed)


def _grain(rng: np.random.Generator, size: int) -> Field:
    """Sawn wood along u, 0 (dark, late wood) to 1: annual rings cut lengthwise, fibres and pores."""
    _, v = coordinates(rng, size)
    lazy = spectral_noise(rng, size, slope=2, high=10, stretch=rng.uniform(5, 12))
    rings = rng.integers(0, 24)
    phase = rings * v + rng.uniform(1.5, 7) * lazy
    ring = phase - np.floor(phase)
    late = ring ** rng.uniform(1.5, 4) * smoothstep(1, 0.85, ring)
    fibre = spectral_noise(rng, size, slope=0.6, low=8, stretch=rng.uniform(25, 60))
    pores = smoothstep(1.2, 2.4, spectral_noise(rng, size, slope=0, low=60, stretch=rng.uniform(10, 30)))
    dark = rng.uniform(0.3, 0.9) * late - rng.uniform(0.06, 0.15) * fibre + rng.uniform(0, 0.35) * pores
    return normalised(-dark, clip_percent=0.2)


def wood_grain(rng: np.random.Generator, size: int) -> Image:
    """One broad board or veneer, lengthwise along either side of the tile."""
    grain = _grain(rng, size)
    blotch = spectral_noise(rng, size, slope=1.5, high=6, stretch=4)
    wood = ramp(grain * 0.9 + 0.05, _wood_tones(rng, 3)) * (1 + 0.05 * blotch)[..., None]
    return np.swapaxes(wood, 0, 1) if rng.random() < 0.5 else wood


def wood_planks(rng: np.random.Generator, size: int) -> Image:
    """Boards with staggered ends, or herringbone parquet; every board from another log."""
    u, v = coordinates(rng, size)
    grain = _grain(rng, size)
    if rng.random() < 0.3:
        cells, lying = herringbone(u, v, int(rng.integers(1, 3)), int(rng.integers(3, 6)))
        value = np.where(lying, shuffled(rng, grain, cells), shuffled(rng, grain.T, cells))
    else:
        rows = int(rng.integers(3, 11))
        cells = courses(u, v, rows, int(rng.integers(1, 3)), rng.random(rows))
        value = shuffled(rng, grain, cells)
    board = rng.normal(0, rng.uniform(0.04, 0.22), cells.count).astype(np.float32)
    value = np.clip(0.15 + 0.7 * value + board[cells.labels], 0, 1)
    gap = rng.uniform(0.0006, 0.0025)
    joint = smoothstep(gap + 1.5 / size, gap, cells.edge) * rng.uniform(0.4, 0.95)
    return mix(ramp(value, _wood_tones(rng, 4)), from_lch(10, 8, 60), joint)


def cork(rng: np.random.Generator, size: int) -> Image:
    """Pressed granules with dark lenticels."""
    cells = voronoi(rng, size, int(rng.integers(25, 60)), wobble=0.25)
    granule = rng.normal(0, 0.18, cells.count).astype(np.float32)[cells.labels]
    fine = spectral_noise(rng, size, slope=0.7, low=20)
    seam = smoothstep(0.0025, 0, cells.edge)
    lenticel = smoothstep(1.3, 1.9, spectral_noise(rng, size, slope=1, low=14, high=60))
    value = 0.6 + granule + 0.12 * fine - 0.2 * seam - rng.uniform(0.2, 0.6) * lenticel
    return ramp(
        np.clip(value, 0, 1),
        tones(rng, 4, lightness=(20, 74), chroma=(25, 45), hue_deg=(58, 75), dyed=0.1),
    )


def cardboard(rng: np.random.Generator, size: int) -> Image:
    """Kraft paper: flutes that show through, fibres, stains and flecks."""
    u, _ = coordinates(rng, size)
    flutes = np.sin(2 * np.pi * int(rng.integers(40, 110)) * u)
    fibres = spectral_noise(rng, size, slope=0.5, low=20, stretch=6, angle_deg=rng.uniform(0, 180))
    cross = spectral_noise(rng, size, slope=0.5, low=20, stretch=6, angle_deg=rng.uniform(0, 180))
    stain = spectral_noise(rng, size, slope=1.6, high=20)
    flecks = smoothstep(2.4, 3.0, fibres + cross * 0.8)
    value = (
        0.55
        + rng.uniform(0.03, 0.12) * flutes
        + 0.1 * (fibres + cross)
        + rng.uniform(0.06, 0.16) * stain
        - 0.5 * flecks
    )
    kraft = tones(rng, 3, lightness=(38, 80), chroma=(14, 32), hue_deg=(66, 82), dyed=0.1)
    return ramp(np.clip(value, 0, 1), kraft)


def leather(rng: np.random.Generator, size: int) -> Image:
    """Hide with creases between pebbles, in any dye."""
    cells = voronoi(rng, size, int(rng.integers(25, 80)), wobble=0.15)
    pebble = np.sqrt(np.minimum(cells.edge * np.sqrt(cells.count), 0.4) / 0.4)
    fine = spectral_noise(rng, size, slope=0.8, low=30)
    wrinkle = np.abs(spectral_noise(rng, size, slope=1.7, low=2, high=40))
    height = pebble + 0.06 * fine + 0.3 * np.minimum(wrinkle, 0.5)
    wear = spectral_noise(rng, size, slope=1.8, high=12)
    value = 0.2 + 0.5 * pebble + 0.12 * wear + 0.04 * fine
    hide = tones(rng, 3, lightness=(14, 72), chroma=(15, 50), hue_deg=(35, 70), dyed=0.5)
    return lit(ramp(np.clip(value, 0, 1), hide), blur(height, 0.001), 0.35 / np.sqrt(cells.count), rng)


def marble(rng: np.random.Generator, size: int) -> Image:
    """Polished stone, clouded and veined."""
    bend = [0.06 * rng.uniform(0.3, 1.5) * spectral_noise(rng, size, slope=1.8, low=1) for _ in range(2)]
    clouds = normalised(warp(spectral_noise(rng, size, slope=1.5), *bend))
    stone = _stone_tones(rng, 3, dyed=0.4)
    if rng.random() < 0.5:
        stone = stone[::-1]
    image = ramp(clouds, stone)
    vein_colours = np.concatenate([palette(rng, 1), from_lch([8, 96], [4, 4], [60, 80])])
    for _ in range(int(rng.integers(1, 4))):
        slope, width = rng.uniform(1.5, 2.2), rng.uniform(0.02, 0.09)
        ridge = np.abs(warp(spectral_noise(rng, size, slope=slope, low=1, high=90), *bend))
        strength = normalised(spectral_noise(rng, size, slope=1.6, high=8)) * rng.uniform(0.4, 1)
        image = mix(image, rng.choice(vein_colours), np.exp(-ridge / width) * strength)
    return image


def granite(rng: np.random.Generator, size: int) -> Image:
    """Crystals of three to five minerals."""
    cells = voronoi(rng, size, int(rng.integers(60, 150)), wobble=0.3)
    minerals = np.concatenate([_stone_tones(rng, 3), palette(rng, 2, chroma=40)])[: rng.integers(3, 6)]
    share = rng.dirichlet(np.full(len(minerals), 1.2))
    crystals = minerals[rng.choice(len(minerals), cells.count, p=share)][cells.labels]
    fine = spectral_noise(rng, size, slope=0.7, low=10)
    return blur(crystals * (1 + 0.07 * fine)[..., None], 0.0007)


def terrazzo(rng: np.random.Generator, size: int) -> Image:
    """Stone chips of many sizes in tinted cement, ground flat."""
    cement = rng.choice(palette(rng, 4, lightness=(20, 92), chroma=35))
    image = mix(cement, from_lch(50, 5, 80), 0.06 * np.abs(spectral_noise(rng, size, slope=0.5, low=20)))
    chips = palette(rng, int(rng.integers(2, 7)))
    veined = 1 + 0.06 * spectral_noise(rng, size, slope=1, low=8)
    for per_side in rng.integers(8, 34, 2):
        cells = voronoi(rng, size, int(per_side), wobble=0.06)
        inset = rng.uniform(0.02, 0.5, cells.count).astype(np.float32)[cells.labels] / per_side
        cover = smoothstep(0, 1.5 / size, cells.edge - inset)
        image = mix(image, rng.choice(chips, cells.count)[cells.labels] * veined[..., None], cover)
    return image


def concrete(rng: np.random.Generator, size: int) -> Image:
    """Cast concrete or plaster: clouds, sand, air holes, sometimes hairline cracks and form joints."""
    clouds = spectral_noise(rng, size, slope=rng.uniform(1.1, 1.7), high=120)
    sand = spectral_noise(rng, size, slope=0.2, low=40)
    value = 0.55 + rng.uniform(0.1, 0.24) * clouds + rng.uniform(0.02, 0.07) * sand
    holes = smoothstep(2.3, 3.0, spectral_noise(rng, size, slope=0.3, low=15, high=rng.uniform(40, 110)))
    value -= rng.uniform(0.2, 0.6) * holes
    if rng.random() < 0.5:
        cracks = voronoi(rng, size, int(rng.integers(3, 6)), wobble=0.12)
        rift = smoothstep(0.0025, 0.0006, cracks.edge)
        value -= 0.6 * rift * normalised(spectral_noise(rng, size, slope=1.5, high=6))
    if rng.random() < 0.3:
        n = int(rng.integers(1, 4))
        panels = courses(*coordinates(rng, size), n, int(rng.integers(1, 3)), np.zeros(n))
        value += rng.normal(0, 0.08, panels.count).astype(np.float32)[panels.labels]
        value -= 0.4 * smoothstep(0.004, 0.0015, panels.edge)
    cement = tones(rng, 3, lightness=(25, 85), chroma=(0, 10), hue_deg=(60, 110), dyed=0.25)
    return ramp(np.clip(value, 0, 1), cement)


def gravel(rng: np.random.Generator, size: int) -> Image:
    """Loose rounded stones, large ones over small ones."""
    stone = np.concatenate([_stone_tones(rng, 4), palette(rng, 2, chroma=rng.choice([15, 50]))])
    image: Image = np.broadcast_to(0.25 * stone[1], (size, size, 3))
    base = int(rng.integers(10, 36))
    for per_side, share in ((5 * base // 2, 1.0), (base, rng.uniform(0.3, 0.95))):
        cells = voronoi(rng, size, per_side, wobble=0.05)
        flank = np.minimum(cells.edge * np.float32(per_side / 0.45), 1)
        dome = blur(np.asarray(1 - (1 - flank) ** 2, np.float32), 0.05 / per_side)
        rough = spectral_noise(rng, size, slope=1, low=base)
        shade = rng.uniform(0.75, 1.25, cells.count).astype(np.float32)[cells.labels] * (1 + 0.07 * rough)
        pebbles = rng.choice(stone, cells.count)[cells.labels] * (shade * (0.4 + 0.6 * dome))[..., None]
        shown = (rng.random(cells.count) < share)[cells.labels]
        image = mix(image, lit(pebbles, dome, 0.3 / per_side, rng), np.where(shown, smoothstep(0.3, 0.4, dome), 0))
    return image


def _metal_tones(rng: np.random.Generator) -> Colours:
    """Steel, aluminium, brass, copper, or anodised in any colour; dark to light."""
    hue, chroma = [(250, 4), (250, 2), (85, 38), (55, 35), (rng.uniform(0, 360), 45)][rng.integers(5)]
    light = rng.uniform(48, 88)
    return from_lch(np.linspace(light - rng.uniform(22, 45), light + 10, 3), chroma, hue)


def brushed_metal(rng: np.random.Generator, size: int) -> Image:
    """Sheet metal with brush lines, scratches and a cloudy sheen."""
    angle = rng.choice([0.0, 90.0, rng.uniform(0, 180)])
    lines = spectral_noise(rng, size, slope=0.3, low=4, stretch=rng.uniform(30, 120), angle_deg=angle)
    scratch = spectral_noise(rng, size, slope=0, low=50, stretch=60, angle_deg=angle + rng.normal(0, 12))
    sheen = spectral_noise(rng, size, slope=1.8, high=8)
    value = 0.5 + rng.uniform(0.08, 0.2) * lines + 0.1 * sheen + 0.3 * smoothstep(2.4, 3.4, scratch)
    return ramp(np.clip(value, 0, 1), _metal_tones(rng))


def tread_plate(rng: np.random.Generator, size: int) -> Image:
    """Chequer plate: raised lozenges that alternate in direction, worn on top."""
    u, v = coordinates(rng, size)
    n = 2 * int(rng.integers(4, 11))
    x, y = u * n, v * n
    turn = np.where((np.floor(x) + np.floor(y)) % 2 == 0, 1.0, -1.0).astype(np.float32)
    dx, dy = x - np.floor(x) - 0.5, (y - np.floor(y) - 0.5) * turn
    along, across = np.abs(dx + dy) / np.sqrt(2), np.abs(dx - dy) / np.sqrt(2)
    height = smoothstep(0.15, 0.07, across + 0.5 * along**2) * smoothstep(0.5, 0.44, along)
    dirt = spectral_noise(rng, size, slope=1.3)
    fine = spectral_noise(rng, size, slope=0.4, low=20)
    value = 0.45 + 0.12 * dirt + 0.05 * fine + rng.uniform(-0.1, 0.35) * height
    return lit(ramp(np.clip(value, 0, 1), _metal_tones(rng)), height, 0.5 / n, rng)


def peeling_paint(rng: np.random.Generator, size: int) -> Image:
    """Paint of any colour that flakes off rust, wood or an older coat."""
    coat, older = palette(rng, 2), palette(rng, 2)
    rust = tones(rng, 3, lightness=(15, 55), chroma=(25, 50), hue_deg=(40, 65), dyed=0)
    rough = normalised(spectral_noise(rng, size, slope=1))
    image = ramp(rough, rust if rng.random() < 0.6 else older)
    flake = spectral_noise(rng, size, slope=rng.uniform(1.2, 1.6), low=int(rng.integers(1, 5)))
    level = rng.uniform(-1, 0.8)
    cover = smoothstep(level, level + 0.05, flake)
    lip = smoothstep(level - 0.12, level, flake) * smoothstep(level + 0.12, level, flake)
    image = mix(image, from_lch(12, 10, 50), 0.6 * lip * (1 - cover))
    painted = coat[0] * (1 + 0.06 * spectral_noise(rng, size, slope=1.2))[..., None]
    return mix(image, painted, cover)
