"""The dataset card: README.md in the dataset's folder, as Hugging Face reads it.

Format: https://huggingface.co/docs/hub/datasets-cards. The same dataset gives the same bytes.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from synthetless.config import BUILTIN, Recipe
from synthetless.dataset.layout import CARD_FILE, DATASET_FILE, MODELS_FOLDER, SYMMETRIES_FILE, ScenePaths, scene_ids
from synthetless.dataset.reader import Scene, read_recipe
from synthetless.io.files import atomic_write, read_json
from synthetless.io.models import object_names, read_models_info
from synthetless.scenes.settings import LightSettings
from synthetless.symmetry import SymmetryTable

_BUILTIN_LICENCE = "The built-in parts of SyntheT-Less, own work, CC0 1.0"
_LICENCES = {
    "cc-by-nc-sa-4.0": r"\bCC[ -]BY[ -]NC[ -]SA[ -]4\.0\b",
    "cc-by-nc-4.0": r"\bCC[ -]BY[ -]NC[ -]4\.0\b",
    "cc-by-sa-4.0": r"\bCC[ -]BY[ -]SA[ -]4\.0\b",
    "cc-by-4.0": r"\bCC[ -]BY[ -]4\.0\b",
    "cc0-1.0": r"\bCC0\b",
    "mit": r"\bMIT\b",
    "apache-2.0": r"\bApache[ -](License )?2\.0\b",
}
"""Hugging Face's names, and how a recipe's licence text may name the same."""
_SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))
_SHARDS = "**/shard-*.tar"
"""What of a folder Hugging Face loads; without this it guesses, and takes the JSON files for the dataset."""
_TASKS = {"rgb": "keypoint-detection", "masks": "image-segmentation", "depth": "depth-estimation"}
_FILES = {
    "rgb": ("`rgb/`", "colour, 8 bits"),
    "depth": ("`depth/`", "16-bit PNG; value × `depth_scale` = z in mm, 0 = none; ray-cast, without noise"),
    "depth_sensed": ("`depth_sensed/`", "the same as a depth camera measures it, with noise and holes"),
    "masks": ("`mask/`, `mask_visib/`", "silhouette of each instance, whole and visible part, 0 or 255"),
    "normals": ("`normals/`", "16-bit PNG; (value − 32768) / 32767 = unit normal, camera frame"),
    "object_coordinates": ("`object_coordinates/`", "16-bit PNG; (value − 32768) × 0.02 = model coordinates in mm"),
    "exr": ("`exr/`", "linear light before exposure, OpenEXR, half floats"),
}


@dataclass(frozen=True)
class ObjectCounts:
    """How often an object is in the images, and how much of it is visible.

    Attributes:
        instances: in all images.
        mean_visib_fract: of them.
        regressors: instances of each regressor.
    """

    instances: int
    mean_visib_fract: float
    regressors: tuple[int, ...]


@dataclass(frozen=True)
class Counts:
    """What is in a dataset: number of images, and each object by its id."""

    images: int
    objects: Mapping[int, ObjectCounts]

    @property
    def instances(self) -> int:
        """In all images."""
        return sum(of_object.instances for of_object in self.objects.values())


def write_card(dataset: Path) -> None:
    """Write README.md into a dataset's folder, from what is in it.

    Raises:
        UserError: the dataset is incomplete or damaged, or the file cannot be written.
    """
    header = read_json(dataset / DATASET_FILE)
    recipe = read_recipe(dataset)
    counts = _count(dataset, recipe.split)
    table = SymmetryTable.read(dataset / SYMMETRIES_FILE)
    names = object_names(read_models_info(dataset / MODELS_FOLDER))
    licence = _licence(recipe)
    parts = [
        _front_matter(recipe, counts, licence),
        _what(recipe, counts, header),
        _contents(recipe, table),
        _making(recipe),
        _objects(counts, table, names),
        _loading(recipe),
        _terms(recipe, licence),
    ]
    atomic_write(dataset / CARD_FILE, ("\n\n".join(parts) + "\n").encode())


def escape(text: str) -> str:
    """Text that Markdown shows as it is, whatever is in it; one line, not to be put at the beginning of one."""
    return re.sub(r"([\\`*_{}\[\]<>#!|~$&:@])", r"\\\1", " ".join(text.split()))


def _count(dataset: Path, split: str) -> Counts:
    images, rows = 0, [np.empty((0, 4))]
    for scene_id in scene_ids(dataset, split) if (dataset / split).is_dir() else ():
        scene = Scene.read(ScenePaths.of(dataset, scene_id, split))
        poses, labels, visibility = scene.labelled()
        images += len(scene)
        rows.append(
            np.column_stack([poses.obj_ids, visibility.visib_fract, labels.regressor_index, labels.n_regressors])
        )
    every = np.concatenate(rows)
    return Counts(
        images, {int(obj_id): _count_object(every[every[:, 0] == obj_id, 1:]) for obj_id in np.unique(every[:, 0])}
    )


def _count_object(rows: NDArray[np.float64]) -> ObjectCounts:
    """From (N, 3): visible fraction, regressor index and number of regressors of an object's instances."""
    visib_fract, index, n_regressors = rows.T
    regressors = np.bincount(index.astype(np.int64), minlength=int(n_regressors.max()))
    return ObjectCounts(len(rows), float(visib_fract.mean()), tuple(regressors.tolist()))


def _licence(recipe: Recipe) -> str:
    """Licence and attribution of the models, "" if the recipe does not say."""
    return recipe.source.licence or (_BUILTIN_LICENCE if recipe.source.models == BUILTIN else "")


def _licence_id(licence: str) -> str:
    """Hugging Face's name of a licence; `other` if the text names none that is known, or several."""
    named = [name for name, pattern in _LICENCES.items() if re.search(pattern, licence, re.IGNORECASE)]
    if not licence:
        return "unknown"
    return named[0] if len(named) == 1 else "other"


def _front_matter(recipe: Recipe, counts: Counts, licence: str) -> str:
    size = next((name for limit, name in _SIZES if counts.images < limit), "1M<n<10M")
    content: dict[str, Any] = {
        "license": _licence_id(licence),
        "task_categories": ["object-detection", *(task for key, task in _TASKS.items() if key in recipe.outputs)],
        "tags": ["6d-pose-estimation", "bop", "synthetic", "symmetry", "texture-less"],
        "pretty_name": " ".join(recipe.name.split()),
        "size_categories": [size],
        "configs": [{"config_name": "default", "data_files": [{"split": "train", "path": _SHARDS}]}],
    }
    return f"---\n{yaml.safe_dump(content, sort_keys=False, allow_unicode=True)}---"


def _what(recipe: Recipe, counts: Counts, header: Mapping[str, Any]) -> str:
    versions = ", ".join(f"{escape(name)} {escape(str(value))}" for name, value in header.get("versions", {}).items())
    mean = counts.instances / counts.images if counts.images else 0.0
    return (
        f"# {escape(recipe.name)}\n\n"
        f"{counts.images} synthetic images with {counts.instances} instances of {len(counts.objects)} "
        f"objects ({mean:.1f} an image), for 6D pose estimation of texture-less, symmetric parts. Objects fall onto a "
        "table and are rendered with Blender Cycles; poses, depth and masks are exact. Every pose also "
        "comes with an unambiguous, learnable label: a canonical pose that is the same for all poses that look alike.\n"
        f"\nMade by SyntheT-Less ({versions})."
    )


def _contents(recipe: Recipe, table: SymmetryTable) -> str:
    extension = recipe.encoding.rgb_format
    rows = [(path, text + (f", .{extension}" if key == "rgb" else "")) for key, (path, text) in _FILES.items()]
    files = [row for key, row in zip(_FILES, rows, strict=True) if key in recipe.outputs]
    files += [
        ("`scene_camera.json`", f"camera matrix, pose and `depth_scale` ({recipe.encoding.depth_scale} mm)"),
        ("`scene_gt.json`", "true poses, model to camera, mm"),
        ("`scene_gt_info.json`", "pixel counts, visible fraction and boxes, as bop_toolkit counts them"),
        ("`scene_gt_coco.json`", "COCO annotations"),
        ("`scene_gt_canonical.json`", "canonical pose, regressor index, discontinuity margin, projected box corners"),
        ("`scene_spec.jsonl`", "everything needed to render each image again"),
    ]
    return (
        "## What is in it\n\n"
        f"A [BOP](https://bop.felk.cvut.cz) dataset: `models/`, `camera.json` and scene folders `{recipe.split}/000001`"
        ", ..., each with\n\n"
        + _table(("file", "content"), files)
        + "\n\nand beside them `dataset.json` (recipe, versions, counts) and `symmetries.json` (what the canonical "
        f"labels were made with, scheme `{table.scheme}`). Millimetres, OpenCV camera frame, pixel (i, j) centred at "
        "(i, j).\n\n"
        "A network that is to predict poses learns `cam_R_m2c_canonical`, `cam_t_m2c_canonical` or the projected "
        "corners `bbox3d_corners_2d`, with one regressor for each `regressor_index` of an object; a pose whose "
        "`discontinuity_margin_deg` is small is close to where its label jumps."
    )


def _making(recipe: Recipe) -> str:
    camera, objects, light = recipe.camera, recipe.objects, recipe.light
    rows = [
        ("seed", str(recipe.seed)),
        (
            "image",
            f"{camera.width} × {camera.height} px, fx {camera.fx}, fy {camera.fy}, cx {camera.cx}, cy {camera.cy}",
        ),
        ("camera", f"{_span(camera.distance_m)} m away, {_span(camera.elevation_deg)}° above the table"),
        ("views of a drop", str(camera.views_per_drop)),
        ("objects in a drop", f"{_span(objects.count)}, and {_span(objects.distractors)} distractors"),
        *_containers(recipe),
        ("models", "built-in parts" if recipe.source.models == BUILTIN else "CAD models, see the licence below"),
        ("grey of the objects", _span(objects.grey)),
        ("table", "procedural textures" if recipe.source.textures == BUILTIN else "photographs"),
        ("lamp", f"{_span(light.elevation_deg)}° above the table, strength {_span(light.strength)}"),
        ("ambient light", _span(light.ambient)),
        *_around(light),
        ("visible", _visibility(recipe.labels.visibility_delta_mm)),
        ("samples a pixel", f"{recipe.render.samples}, denoiser {recipe.render.denoiser}"),
    ]
    return f"## How it was made\n\n{_table(('setting', 'value'), rows)}\n\nThe whole recipe is in `dataset.json`."


def _containers(recipe: Recipe) -> list[tuple[str, str]]:
    of = recipe.release.container
    kinds = (("box", of.box), ("tray", of.tray))
    named = [f"{asked.share:.0%} of the drops in a {kind}" for kind, asked in kinds if asked.share > 0]
    return [("containers", ", ".join(named))] if named else []


def _around(light: LightSettings) -> list[tuple[str, str]]:
    """What stands around the table, if anything does."""
    around = [] if light.room is None else [f"a lit room with {_span(light.room.lamps)} soft lamps"]
    around += [] if light.environments is None else [f"panoramas, in {light.environment_share:.0%} of the drops"]
    return [("around the table", "; ".join(around))] if around else []


def _visibility(delta_mm: float) -> str:
    behind = f", or up to {delta_mm:g} mm behind it along the ray, as in BOP" if delta_mm else ""
    return f"what is the nearest surface{behind}"


def _objects(counts: Counts, table: SymmetryTable, names: Mapping[int, str]) -> str:
    rows = []
    for obj_id, of_object in counts.objects.items():
        shares = [count / of_object.instances for count in of_object.regressors]
        rows.append(
            (
                f"{obj_id} {escape(names[obj_id])}" if obj_id in names else str(obj_id),
                table.entries[obj_id].group.name if obj_id in table.entries else "",
                str(of_object.instances),
                f"{of_object.mean_visib_fract:.1%}",
                str(len(of_object.regressors)),
                " / ".join(f"{share:.0%}" for share in shares),
            )
        )
    head = ("object", "symmetry", "instances", "visible on average", "regressors", "instances by regressor")
    return f"## Objects\n\n{_table(head, rows)}"


def _loading(recipe: Recipe) -> str:
    scene = f"{recipe.split}/000001"
    return f"""## How to load it

With [bop_toolkit](https://github.com/thodan/bop_toolkit), or any reader of BOP datasets:

```python
from bop_toolkit_lib import inout

poses = inout.load_scene_gt("{scene}/scene_gt.json")
cameras = inout.load_scene_camera("{scene}/scene_camera.json")
labels = inout.load_json("{scene}/scene_gt_canonical.json", keys_to_int=True)
```

With pycocotools, torchvision or FiftyOne, after `synthetless export coco . --to coco.json`:

```python
from pycocotools.coco import COCO

coco = COCO("coco.json")
masks = [coco.annToMask(annotation) for annotation in coco.loadAnns(coco.getAnnIds(imgIds=1))]
```

With webdataset or Hugging Face datasets, after `synthetless export webdataset . --to shards`:

```python
import glob
import webdataset

for sample in webdataset.WebDataset(sorted(glob.glob("shards/shard-*.tar")), shardshuffle=False).decode():
    poses, labels = sample["gt.json"], sample["gt_canonical.json"]
```

```python
from datasets import load_dataset

images = load_dataset("webdataset", data_files={{"train": "shards/shard-*.tar"}}, split="train", streaming=True)
```

The folder of the shards has a copy of this card: uploaded to the hub, it is loaded by its name alone."""


def _terms(recipe: Recipe, licence: str) -> str:
    lines = [
        "## Licence and attribution",
        "",
        "The images show the models: whoever passes them on respects the licence of the models.",
        "",
        f"Models: {escape(licence) if licence else 'the recipe does not state a licence; ask where they come from.'}",
        "",
    ]
    if recipe.source.textures == BUILTIN:
        lines.append("Table: procedural textures of SyntheT-Less, CC0 1.0.")
    else:
        lines.append("Table: photographs; their licence is not recorded here, state it when you publish the dataset.")
    lines += [
        "",
        "Canonical poses and regressors: G. Pitteri, M. Ramamonjisoa, S. Ilic, V. Lepetit: On Object Symmetries and 6D "
        "Pose Estimation from Images, 3DV 2019.",
    ]
    return "\n".join(lines)


def _span(bounds: tuple[float, float]) -> str:
    low, high = bounds
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)
