"""The report of `nmpm doctor`, and what it says of failures."""

import re
from pathlib import Path

import pytest

from nmpm.cli import main
from nmpm.zoo import installation, self_test
from nmpm.zoo.verification import Check


def test_the_report_is_complete_without_paths_of_the_home_and_passes(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("NMPM_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "cache" / "zoo").mkdir(parents=True)
    (tmp_path / "cache" / "zoo" / "weights").write_bytes(bytes(3_000_000))
    assert main(["doctor"]) == 0
    report = capsys.readouterr().out
    assert str(tmp_path) not in report
    for line in ("NMPM_HOME      ~/cache", "zoo            3 MB, your models", "rollouts       Numba kernels"):
        assert f"  {line}\n" in report
    tests = re.findall(r"pass +(.*?): ", report)
    assert len(tests) == 9  # all of them were run: figures of two shipped files are no test of an installation
    assert tests[0] == "golden rollout of 32 frames, repeated"
    assert set(tests[1:7]) == {"test scene 0, rolled out", "test scene 1, rolled out"}
    assert set(tests[7:]) == {"training of 10 steps, run"}
    assert re.search(r"  speed +\d+\.\d\d ms per frame of 1,681 particles, .* The card states ", report)
    assert "FAIL" not in report
    assert report.splitlines()[-1].startswith("The self-test passed.")


def test_a_failed_test_is_the_last_line_and_the_status(monkeypatch, capsys):
    monkeypatch.setattr(installation, "sections", lambda device: {"self-test": lambda: installation.outcomes(device)})
    monkeypatch.setattr(self_test, "self_test", lambda device: iter([Check("loss", 1.0, 2.0, 0.9, 1.1)]))
    monkeypatch.setattr(self_test, "speed", lambda device: "fast")
    assert main(["doctor"]) == 1
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("FAILED: loss: 2; the card states 1, passes from 0.9 to 1.1")


def test_what_is_broken_does_not_end_the_report(monkeypatch, capsys):
    def broken():
        yield "first", "known"
        raise ImportError("libcudart.so is missing")

    monkeypatch.setattr(installation, "sections", lambda _: {"gpu": broken, "versions": installation.versions})
    assert main(["doctor"]) == 1
    report = capsys.readouterr().out
    assert "  first          known\n  ERROR          ImportError: libcudart.so is missing\n\nversions\n" in report
    assert report.splitlines()[-1].startswith("FAILED: ImportError: libcudart.so is missing")


@pytest.mark.parametrize(
    ("cpuinfo", "names"),
    [
        ("flags\t: fpu avx2 amx_tile avx512f\n", ["AVX2", "AVX-512", "AMX"]),
        ("Features\t: fp asimd bf16\n", ["bfloat16", "NEON"]),
    ],
)
def test_instructions_are_read_from_linux(monkeypatch, cpuinfo, names):
    monkeypatch.setattr(Path, "read_text", lambda path: cpuinfo)
    assert installation.instructions() == names
