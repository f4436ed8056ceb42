"""Crops, their labels, the head and the training loop, up to the paper's point: true poses cannot be learned."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from packages import package_or_skip

torch = package_or_skip("torch", "extra 'learn' has it")

from synthetless.dataset import Dataset  # noqa: E402
from synthetless.errors import UserError  # noqa: E402
from synthetless.io.models import load_models  # noqa: E402
from synthetless.learning import compare as comparing  # noqa: E402
from synthetless.learning import fit as fitting  # noqa: E402
from synthetless.learning.compare import Comparison, CropSets, compare, rendered_crops, train_crops  # noqa: E402
from synthetless.learning.crops import CropBatcher, CropNet, _turn  # noqa: E402
from synthetless.learning.heads import PoseHead, coset_loss, existing, pose_losses  # noqa: E402
from synthetless.learning.pages import line_chart  # noqa: E402
from synthetless.learning.solve import solve_pose  # noqa: E402
from synthetless.learning.stream import CropSettings, CropStream, upright  # noqa: E402
from synthetless.learning.targets import LABEL_SETS, LabelMaker, LabelSet, rolled, turned  # noqa: E402
from synthetless.symmetry import SymmetryTable  # noqa: E402

OBJECTS = (18, 27, 29, 30)


@pytest.fixture(scope="module")
def models(builtin_models: Path) -> Any:
    return load_models(builtin_models, OBJECTS)


@pytest.fixture(scope="module")
def stream(models: Any) -> CropStream:
    return CropStream(models, CropSettings(), 1)


@pytest.fixture(scope="module")
def table(models: Any) -> SymmetryTable:
    return SymmetryTable.from_models_info({i: model.info for i, model in models.items()})


def _batcher(models: Any, table: SymmetryTable, labels: Any) -> CropBatcher:
    return CropBatcher(LabelMaker(labels, table), {i: m.box_corners_mm for i, m in models.items()}, OBJECTS)


def test_a_crop_follows_from_the_seed_and_its_number_alone(stream: CropStream, models: Any) -> None:
    once, again = stream.crops(0, 12), CropStream(models, CropSettings(), 1).crops(4, 2, step=4)
    assert (once.pixels[[4, 8]] == again.pixels).all()
    assert (once.R_m2c[[4, 8]] == again.R_m2c).all()
    other = CropStream(models, CropSettings(), 2).crops(0, 12)
    assert not (other.pixels == once.pixels).all()


def test_the_part_is_where_its_pose_says(stream: CropStream, models: Any) -> None:
    """All vertices of the posed model are inside the crop, and they fill most of it."""
    crops = stream.crops(0, 40)
    for i in range(40):
        seen = (models[int(crops.obj_ids[i])].vertices_mm @ crops.R_m2c[i].T + crops.t_m2c[i]) @ crops.K[i].T
        pixels = seen[:, :2] / seen[:, 2:]
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        assert low.min() > -1
        assert high.max() < 48
        assert 48 / 1.36 < (high - low).max() < 48 / 1.09


def test_upright_parts_are_upright() -> None:
    R = upright(np.radians(30), 1.0, 0.0)
    assert np.allclose(R @ R.T, np.eye(3))
    assert np.linalg.det(R) == pytest.approx(1)
    assert R[2, 2] == pytest.approx(-0.5)  # the axis points away from the camera's view by 90 + 30 degrees
    assert R[1, 2] < 0  # up in the picture
    assert R[0, 2] == pytest.approx(0)


@pytest.mark.parametrize("labels", LABEL_SETS)
def test_a_turned_crop_has_the_corners_of_the_turned_pose(
    stream: CropStream, models: Any, table: SymmetryTable, labels: Any
) -> None:
    crops, batcher = stream.crops(0, 32), _batcher(models, table, labels)
    angles = np.random.default_rng(0).uniform(-3, 3, 32)
    R, t = turned(rolled(angles), crops.R_m2c, crops.t_m2c)
    true = batcher if labels == "true" else _batcher(models, table, "true")
    before = true.batch(crops).corners.numpy()
    after = true.batch(type(crops)(crops.pixels, crops.obj_ids, R, t, crops.K, crops.elevation_deg)).corners.numpy()
    assert np.allclose(np.einsum("nij,nkj->nki", rolled(angles)[:, :2, :2], before), after, atol=1e-5)
    batch = batcher.augmented(crops, np.random.default_rng(1), 180)
    assert batch.pixels.shape == (32, 3, 48, 48)
    assert (batch.index < batch.counts).all()


def test_a_picture_turns_the_way_its_pose_does() -> None:
    """A bright dot to the right of the centre moves down by a quarter turn: x towards y."""
    picture = np.zeros((49, 49, 3), dtype=np.uint8)
    picture[24, 40] = 255
    moved = _turn(picture, np.pi / 2)
    row, column = np.unravel_index(moved[..., 0].argmax(), (49, 49))
    assert (row, column) == (40, 24)
    assert np.allclose(rolled(np.pi / 2) @ [1, 0, 1], [0, 1, 1])


def test_only_the_responsible_regressor_learns() -> None:
    head = PoseHead(6, classes=2, regressors=3)
    features = torch.randn(4, 6)
    classes, index, counts = torch.tensor([0, 1, 1, 0]), torch.tensor([0, 1, 0, 0]), torch.tensor([1, 2, 2, 1])
    losses = pose_losses(head(features).of_class(classes), torch.randn(4, 8, 2), index, counts)
    losses["corners"].backward(retain_graph=True)
    moved = head.corners.weight.grad.reshape(2, 3, 16, 6).abs().sum(dim=(2, 3)) > 0
    assert moved.tolist() == [[True, False, False], [True, True, False]]
    assert existing(torch.zeros(2, 3), torch.tensor([1, 3]))[0].tolist() == [0, -np.inf, -np.inf]
    assert losses["index"].item() >= 0
    empty = pose_losses(head(features[:0]).of_class(classes[:0]), torch.zeros(0, 8, 2), index[:0], counts[:0])
    assert [loss.item() for loss in empty.values()] == [0, 0]


def test_labels_near_a_jump_can_count_for_less() -> None:
    output = PoseHead(6, 1, 1)(torch.randn(3, 6)).of_class(torch.zeros(3, dtype=torch.int64))
    corners, index, counts = torch.randn(3, 8, 2), torch.zeros(3, dtype=torch.int64), torch.ones(3, dtype=torch.int64)
    distances = (output.corners[:, 0] - corners).abs().mean(dim=(1, 2))
    for weights in ([1.0, 1, 1], [0, 0.5, 1], [0, 0, 0]):
        found = pose_losses(output, corners, index, counts, torch.tensor(weights))["corners"].item()
        expected = np.average(distances.detach().numpy(), weights=weights) if any(weights) else 0
        assert found == pytest.approx(expected, abs=1e-6)
    equal = pose_losses(output, corners, index, counts)["corners"].item()
    assert equal == pytest.approx(distances.mean().item(), abs=1e-6)


def test_corners_of_a_label_are_solved_to_its_pose(stream: CropStream, models: Any, table: SymmetryTable) -> None:
    crops = stream.crops(0, 24)
    corners = _batcher(models, table, "true").batch(crops).corners.numpy().astype(float) * 48 + 23.5
    for i in range(24):
        pose = solve_pose(corners[i], models[int(crops.obj_ids[i])].box_corners_mm, crops.K[i])
        assert pose is not None
        assert np.abs(pose.R_m2c - crops.R_m2c[i]).max() < 0.01


def test_every_coset_that_is_left_open_is_right() -> None:
    p = torch.tensor([[0.7, 0.2, 0.1], [0.7, 0.2, 0.1], [0.5, 0.5, 0.0]])
    alike = torch.tensor([[True, False, False], [False, True, True], [True, True, False]])
    logits = torch.log(p).requires_grad_()
    loss = coset_loss(logits, alike, torch.tensor([3, 3, 2]))
    assert loss.item() == pytest.approx(-(np.log(0.7) + np.log(0.3) + np.log(1.0)) / 3, abs=1e-6)
    loss.backward()
    assert torch.isfinite(logits.grad).all() and logits.grad[2].abs().max() < 1e-6
    nothing = coset_loss(logits[:0], alike[:0], torch.zeros(0, dtype=torch.int64))
    assert nothing.item() == 0


@pytest.mark.parametrize(
    "corners", [np.zeros((8, 2)), np.full((8, 2), np.nan), np.full((8, 2), np.inf), np.eye(8, 2) * 1e-3 + 20]
)
def test_collapsed_corners_are_a_miss_and_no_crash(corners: Any, models: Any) -> None:
    K = np.array([[500.0, 0, 24], [0, 500, 24], [0, 0, 1]])
    assert solve_pose(corners, models[27].box_corners_mm, K) is None


def test_mapped_labels_are_learned_and_true_poses_are_not(models: Any) -> None:
    """The paper's point: 300 steps, the same network, crops and steps."""
    torch.set_num_threads(1)
    comparison = Comparison(Path("unused"), steps=300, batch=48, width=12)
    stream = CropStream(models, comparison.crops, 1)
    crops = CropSets(stream.crops(0, 2000), stream.crops(10_000, 300))
    l1, spread = {}, {}
    for labels in ("true", "map"):
        row = train_crops(comparison, models, crops, labels, 0).run.rows["all"]
        l1[labels], spread[labels] = row.l1, row.spread
    assert l1["map"] < 0.7 * l1["true"]
    assert spread["true"] < 0.6 < spread["map"]


def test_a_logarithmic_axis_has_numbers() -> None:
    drawn = line_chart({"a": ([1, 2], [0.03, 0.3])}, "x", "y", logarithmic=True)
    assert b">0.1<" in drawn and b">0.2<" in drawn
    assert b"mathdefault" not in drawn


def test_a_small_comparison_writes_its_page(builtin_models: Path, tmp_path: Path) -> None:
    comparison = Comparison(builtin_models, (27, 30), ("true", "atlas"), 1, 4, 8, 20, 12)
    runs = compare(comparison, tmp_path / "out", workers=1)
    assert [(run.labels, run.seed) for run in runs] == [("true", 0), ("atlas", 0)]
    page = (tmp_path / "out" / "index.html").read_text()
    assert page.count("<svg") == 1
    assert page.count("<img") == 2
    assert len(list((tmp_path / "out" / "pictures").iterdir())) == 2
    kept = json.loads((tmp_path / "out" / "runs.json").read_text())
    assert kept["atlas 0"]["rows"]["all"]["crops"] == 12
    assert compare(comparison, tmp_path / "again", workers=1)[1].rows == runs[1].rows


def test_an_interrupted_comparison_goes_on(
    builtin_models: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is finished is used again, what is missing is made, and the outcome is that of one call."""
    sets: tuple[LabelSet, ...] = ("true", "map", "atlas")
    out = tmp_path / "out"
    whole = compare(Comparison(builtin_models, (27, 30), sets, 1, 3, 8, 20, 12), tmp_path / "whole", 1)

    def interrupted(task: Any) -> Any:
        if task.labels == "atlas":
            raise KeyboardInterrupt
        return run(task)

    run = comparing._run
    comparison = Comparison(builtin_models, (27, 30), sets, 1, 3, 8, 20, 12)
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(comparing, "_run", interrupted)
        compare(comparison, out, 1)
    kept = {path.name: path.stat().st_mtime_ns for path in (out / "runs").iterdir()}
    assert sorted(kept) == ["map-0.pt", "true-0.pt"]
    crops = {path: path.stat().st_mtime_ns for path in (out / "crops").rglob("*.npy")}
    again = compare(comparison, out, 1)
    assert {path: path.stat().st_mtime_ns for path in (out / "crops").rglob("*.npy")} == crops
    assert {name: (out / "runs" / name).stat().st_mtime_ns for name in kept} == kept
    assert [run.rows for run in again] == [run.rows for run in whole]
    more = Comparison(builtin_models, (27, 30), ("map",), 2, 3, 8, 20, 12)  # other sets and seeds are other runs
    assert [run.seed for run in compare(more, out, 1)] == [0, 1]


def test_runs_of_other_settings_are_not_used_again(builtin_models: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    compare(Comparison(builtin_models, (27,), ("map",), 1, 2, 4, 12, 8), out, 1)
    with pytest.raises(UserError, match=r"out: holds a comparison with other settings \(steps\); give another folder"):
        compare(Comparison(builtin_models, (27,), ("map",), 1, 3, 4, 12, 8), out, 1)
    with pytest.raises(UserError, match=r"other settings \(models\)"):
        compare(Comparison(builtin_models, (30,), ("map",), 1, 2, 4, 12, 8), out, 1)
    with pytest.raises(UserError, match=r"other settings \(crops\)"):
        compare(Comparison(builtin_models, (27,), ("map",), 1, 2, 4, 12, 8, CropSettings(poses="any")), out, 1)
    (out / "runs" / "map-0.pt").write_bytes(b"PK")
    with pytest.raises(UserError, match=r"map-0\.pt: is no checkpoint, or is damaged"):
        compare(Comparison(builtin_models, (27,), ("map",), 1, 2, 4, 12, 8), out, 1)


def test_a_comparison_is_measured_on_a_dataset_too(valid: Path, tmp_path: Path) -> None:
    """Crops of the dataset's instances, in rows of their own."""
    crops = CropSettings(poses="any")
    comparison = Comparison(valid / "models", (2, 3), ("map",), 1, 2, 8, 12, 8, crops, rendered=valid)
    (run,) = compare(comparison, tmp_path / "out", workers=1)
    assert run.rows["rendered, all"].crops == sum(
        n.obj_id in (2, 3) and n.visibility is not None and n.visibility.visib_fract >= 0.6
        for image in Dataset.open(valid)
        for n in image.instances
    )
    assert "On rendered images" in (tmp_path / "out" / "index.html").read_text()
    tuned = replace(comparison, tuning=valid, tuning_steps=40)  # learns from what it is measured on
    (after,) = compare(tuned, tmp_path / "out", workers=1)
    assert {name: row for name, row in after.rows.items() if not name.startswith("tuned")} == run.rows
    assert after.rows["tuned, all"].crops == after.rows["rendered, all"].crops
    assert after.rows["tuned, all"].l1 < 0.9 * after.rows["rendered, all"].l1
    assert "After tuning" in (tmp_path / "out" / "index.html").read_text()
    upright = Comparison(valid / "models", (2, 3), ("map",))
    with pytest.raises(UserError, match="no instance of the objects that is visible enough and stands as needed"):
        rendered_crops(upright, valid)  # they lie in any pose


def test_wrong_comparisons_are_one_line(builtin_models: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="unknown label set 'maps'"):
        Comparison(builtin_models, labels=("maps",))  # type: ignore[arg-type]
    with pytest.raises(UserError, match="steps is 0"):
        Comparison(builtin_models, steps=0)
    with pytest.raises(UserError, match="a dataset to tune on is given, but none of rendered images to measure on"):
        Comparison(builtin_models, tuning=tmp_path)
    with pytest.raises(UserError, match="no mesh for object 99"):
        compare(Comparison(builtin_models, objects=(99,)), tmp_path / "out", 1)
    with pytest.raises(UserError, match="no BOP dataset"):
        compare(Comparison(builtin_models, rendered=tmp_path), tmp_path / "out", 1)
    assert not (tmp_path / "out").exists()


def _tiny(run: Path, steps: int, save_every: int = 10) -> Any:
    """A training run on numbers; its batches follow from the step."""
    torch.manual_seed(0)
    torch.set_num_threads(1)
    net = torch.nn.Sequential(torch.nn.Linear(5, 8), torch.nn.BatchNorm1d(8), torch.nn.ReLU(), torch.nn.Linear(8, 2))

    def losses(step: int) -> Any:
        rng = np.random.default_rng([1, step])
        x = torch.from_numpy(rng.standard_normal((16, 5))).float()
        if os.environ.get("SLOW"):
            time.sleep(0.02)
        return {"square": (net(x) - x[:, :2]).square().mean()}

    schedule = fitting.Schedule(steps, 2e-2, log_every=5, save_every=save_every)
    return net, list(fitting.fit(net, losses, schedule, run))


def test_training_learns_and_logs(tmp_path: Path) -> None:
    _, records = _tiny(tmp_path, 60)
    assert [record["step"] for record in records] == list(range(5, 61, 5))
    assert records[-1]["square"] < 0.7 * records[0]["square"]
    assert [r["step"] for r in fitting.read_log(tmp_path)] == [r["step"] for r in records]


def test_a_killed_run_resumes_to_the_same_weights(tmp_path: Path) -> None:
    whole, _ = _tiny(tmp_path / "whole", 60)
    code = f"from test_crops import _tiny; from pathlib import Path; _tiny(Path({str(tmp_path / 'killed')!r}), 60, 7)"
    folder = Path(__file__).parent
    environment = os.environ | {
        "SLOW": "1",
        "PYTHONPATH": os.pathsep.join([str(folder), str(folder.parent), *sys.path]),
    }
    victim = subprocess.Popen([sys.executable, "-c", code], env=environment, cwd=tmp_path)
    checkpoint = tmp_path / "killed" / fitting.CHECKPOINT_FILE
    while not checkpoint.exists() and victim.poll() is None:
        time.sleep(0.02)
    victim.send_signal(signal.SIGKILL)
    assert victim.wait() == -signal.SIGKILL
    assert 0 < fitting.load(checkpoint)["step"] < 60
    resumed, _ = _tiny(tmp_path / "killed", 60, 7)
    for name, value in whole.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name
    assert [r["step"] for r in fitting.read_log(tmp_path / "killed")] == list(range(5, 61, 5))


def test_damaged_and_foreign_checkpoints_are_one_line(tmp_path: Path) -> None:
    _tiny(tmp_path, 10)
    path = tmp_path / fitting.CHECKPOINT_FILE
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UserError, match="is no checkpoint, or is damaged"):
        _tiny(tmp_path, 20)
    fitting.save(path, {"model": CropNet(48, 1, 1).state_dict(), "optimizer": {}, "step": 1})
    with pytest.raises(UserError, match="the weights are of another network"):
        _tiny(tmp_path, 20)
    fitting.save(path, {"weights": {}})
    with pytest.raises(UserError, match="is no checkpoint of a training run"):
        _tiny(tmp_path, 20)


def test_a_loss_that_is_not_finite_stops_the_run() -> None:
    net = torch.nn.Linear(1, 1)
    with pytest.raises(UserError, match="step 0: the loss is nan"):
        list(fitting.fit(net, lambda _: {"bad": net(torch.ones(1, 1)).sum() * torch.nan}, fitting.Schedule(3)))
