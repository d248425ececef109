from __future__ import annotations

import pytest

from benchmarks.rendering import main


@pytest.mark.slow
def test_the_benchmark_runs_and_both_ways_agree(capsys: pytest.CaptureFixture[str]) -> None:
    main(["--quick"])
    printed = capsys.readouterr().out
    for row in ("bare cv2.remap", "equirect_to_tangent, 4 images", "owners", "tangent_to_labels"):
        assert row in printed
    plain, careful = (
        float(word.rstrip("%"))
        for word in printed.partition("labels agree")[2].splitlines()[0].split()
        if word.endswith("%")
    )
    assert min(plain, careful) > 99.5
