"""What ray casting calls alike is what Blender renders alike, and the other way round."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.ambiguity_rendered import compare
from synthetless.symmetry.ambiguity import MIN_PIXELS

pytestmark = pytest.mark.blender


def test_pictures_differ_by_more_than_noise_exactly_where_rays_tell_the_poses_apart(tmp_path: Path) -> None:
    found = list(compare(3, tmp_path / "log"))
    assert [each.contradictions for each in found] == [0, 0, 0]
    assert sum(int((each.apart == 0).sum()) for each in found) > len(found)  # more than the true poses themselves
    assert all((each.apart >= MIN_PIXELS).any() for each in found)
