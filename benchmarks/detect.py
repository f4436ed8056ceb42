"""Time the detection of symmetries, and compare it with a declared list: ``python -m benchmarks.detect [MODELS_DIR]``.

Without a folder it takes the one that SYNTHETLESS_TLESS_MODELS names, or else the parts that come with the project.
Wall time and the CPU time of all processes, their start included; what other programs do meanwhile lengthens both.
With --markdown (T-LESS only) it writes docs/symmetry_tless.md, what was found beside what BOP declares.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from benchmarks import ROOT, cpu_s, default_models, keep
from synthetless.io.files import atomic_write
from synthetless.io.parallel import usable_cores
from synthetless.symmetry.detection import Detected, DetectedFolder, DetectedObject, GroupFit, detect_folder
from synthetless.symmetry.detection.report import axis_text

PAGE = ROOT / "docs" / "symmetry_tless.md"

INTRODUCTION = """# Symmetries of the T-LESS CAD models: detected and declared

Written by `python -m benchmarks.detect --markdown` from the 30 CAD models of T-LESS (Hodaň et al., WACV 2017).

A residual is the distance between the surface and its image, over all elements of the group, in both directions: the
largest one, the 95th percentile and the root mean square. *Declared* is the group in BOP's `models_info.json`, about
the axis that stands there. *Detected* is the largest group whose largest residual is at most {tolerance:g} % of the
diameter. *Next larger* is the group that would be the answer if more was tolerated, and how much that would take.

| object | diameter mm | declared | max mm | max % | p95 mm | rms mm | detected | max % | next larger |
|---:|---:|---|---:|---:|---:|---:|---|---:|---|
"""

CONCLUSION = """At {tolerance:g} % the detected group is the declared one for {n_agreeing} of {n} objects ({agreeing}).
The others are declared across differences that the pictures show (`synthetless symmetries detect --pictures DIR`). No
single tolerance gives BOP's list: the best one, {best:.1f} %, gives {n_best} of {n}. Which differences shall count is a
decision, and the residual table is there to make it.
"""


def main() -> None:
    """Measure, print a table, write benchmarks/results/detect.json and perhaps docs/symmetry_tless.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("models", type=Path, nargs="?", default=default_models(), help="a BOP models folder")
    parser.add_argument("--workers", type=int, default=usable_cores(), help="processes")
    parser.add_argument("--markdown", action="store_true", help="write docs/symmetry_tless.md")
    arguments = parser.parse_args()

    wall, cpu = time.perf_counter(), cpu_s()
    detected = detect_folder(arguments.models, workers=arguments.workers)
    wall, cpu = time.perf_counter() - wall, cpu_s() - cpu
    agreeing = [o.obj_id for o in detected.objects if _agrees(o.detected, o.detected.answer)]
    print(f"{len(detected.objects)} meshes, {arguments.workers} processes: {wall:.1f} s, CPU {cpu:.1f} s")
    print(f"as declared at {detected.tolerance_percent:g} %: {len(agreeing)}")
    result = {
        "meshes": len(detected.objects),
        "workers": arguments.workers,
        "wall_s": round(wall, 1),
        "cpu_s": round(cpu, 1),
        "as_declared": agreeing,
    }
    keep("detect", result)
    if arguments.markdown:
        atomic_write(PAGE, page(detected).encode())
        print(PAGE.relative_to(ROOT))


def page(detected: DetectedFolder) -> str:
    """The comparison as Markdown."""
    head = INTRODUCTION.format(tolerance=detected.tolerance_percent)
    return head + "".join(map(_row, detected.objects)) + "\n" + _conclusion(detected)


def _row(o: DetectedObject) -> str:
    found, declared = o.detected, o.detected.declared
    cells = [str(o.obj_id), f"{found.diameter_mm:.1f}"]
    if declared is None:
        cells += ["-"] * 5
    else:
        residual = declared.residual
        cells += [_named(declared), f"{residual.max_mm:.2f}", _percent(declared, found)]
        cells += [f"{residual.p95_mm:.2f}", f"{residual.rms_mm:.2f}"]
    cells += [_named(found.answer), _percent(found.answer, found)]
    larger = found.next_larger
    cells.append("-" if larger is None else f"{_named(larger)}: {_percent(larger, found)} %")
    return "| " + " | ".join(cells) + " |\n"


def _conclusion(detected: DetectedFolder) -> str:
    """What the table shows, in numbers that follow from it."""
    objects = [o.detected for o in detected.objects if o.detected.declared is not None]
    agreeing = [o.obj_id for o in detected.objects if _agrees(o.detected, o.detected.answer)]
    costs = sorted(100 * f.residual.max_mm / o.diameter_mm for o in objects for f in o.fits)
    best = max(costs, key=lambda percent: _n_agreeing(objects, percent))
    return CONCLUSION.format(
        tolerance=detected.tolerance_percent,
        n_agreeing=len(agreeing),
        n=len(objects),
        agreeing=", ".join(map(str, agreeing)),
        best=best,
        n_best=_n_agreeing(objects, best),
    )


def _n_agreeing(objects: list[Detected], percent: float) -> int:
    return sum(_agrees(o, o.answer_at(percent / 100 * o.diameter_mm * (1 + 1e-9))) for o in objects)


def _agrees(found: Detected, answer: GroupFit) -> bool:
    return found.declared is not None and answer.group.name == found.declared.group.name


def _named(fit: GroupFit) -> str:
    axis = fit.group.axis
    return fit.group.name if axis is None else f"{fit.group.name} about {axis_text(axis)}"


def _percent(fit: GroupFit, found: Detected) -> str:
    return f"{100 * fit.residual.max_mm / found.diameter_mm:.2f}"


if __name__ == "__main__":
    main()
