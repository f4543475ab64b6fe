"""A scene with meshes through the whole program: steps, checkpoint, dumped problems, the shapes in the output."""

from __future__ import annotations

import numpy as np
from program import assert_same_bits

from pctt.folder import Folder
from pctt.scenes import Drum

DRUM = ("-scene", "drum", "-scene_n", 4, "-scene_length", 2, "-scene_fill", 0.15, "-ccp_type", "apgd", "-delta", 0.003)
DRUM = (*DRUM, "-output_every", 1)


def test_a_drum_runs_goes_on_and_is_written(program, tmp_path):
    program(*DRUM, "-steps", 4, "-output", "whole", "-dump_problem", "problems")
    program(*DRUM, "-steps", 2, "-output", "parts")
    program(*DRUM, "-steps", 2, "-output", "parts", "-restart", "parts/checkpoint.h5")
    for name in ("state.h5", "checkpoint.h5"):
        assert_same_bits(tmp_path / "whole" / name, tmp_path / "parts" / name)
    folder = Folder(tmp_path / "whole")
    folder.require_frames()
    drum, ends = folder.large
    assert [shape["kind"] for shape in drum["shapes"] + ends["shapes"]] == ["Mesh"] * 3
    assert np.shape(drum["shapes"][0]["vertices"]) == (2 * Drum.sides, 3)
    assert np.shape(drum["shapes"][0]["triangles"]) == (2 * Drum.sides, 3)
    assert (folder.frame(4).contacts.bodies >= folder.grains).any()
    files = sorted(path.name for path in (tmp_path / "problems").iterdir())
    assert files
    program("-problem", f"problems/{files[0]}", "-ccp_type", "apgd", "-output", "solved")
