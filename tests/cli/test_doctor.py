"""`gsopt doctor` says what is there, what is missing, and never fails."""

from __future__ import annotations

import json
from importlib import metadata

import pytest
from fake_mps import fake_mps
from simt_runtime import SimtRuntime

from gsopt import cli
from gsopt.cli import doctor
from gsopt.cli.doctor import Package
from gsopt.errors import MissingDependency


@pytest.fixture
def requirements(monkeypatch: pytest.MonkeyPatch) -> None:
    """Metadata with one package that is there and three that no one has."""
    lines = ["numpy>=1", 'no-such-one>=2; extra == "first"', "no.such-two; extra == 'second'", "no_such_three"]
    monkeypatch.setattr(metadata, "requires", lambda name: lines)


def findings(capsys: pytest.CaptureFixture[str]) -> dict:
    assert cli.main(["doctor", "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_the_versions_are_those_installed(requirements: None, capsys: pytest.CaptureFixture[str]) -> None:
    packages = findings(capsys)["packages"]
    assert packages[0] == {"name": "numpy", "extra": "", "version": metadata.version("numpy")}
    assert [package["version"] for package in packages[1:]] == [None, None, None]


def test_each_missing_extra_comes_with_its_pip_line(requirements: None, capsys: pytest.CaptureFixture[str]) -> None:
    missing = findings(capsys)["missing_extras"]
    assert set(missing) == {"", "first", "second"}
    assert missing["first"].endswith("-m pip install 'gsopt[first]'")


@pytest.mark.parametrize(
    ("line", "package"),
    [
        ("numpy>=1.26", Package("numpy", "", metadata.version("numpy"))),
        ('no-such>=1,<2; extra == "a-b"', Package("no-such", "a-b", None)),
        ("no.such[x]>=1; python_version > '3' and extra == 'viewer'", Package("no.such", "viewer", None)),
    ],
)
def test_requirements_are_read_as_pip_writes_them(line: str, package: Package) -> None:
    assert doctor.parse_requirement(line) == package


def test_without_metadata_the_text_says_how_to_install(monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    def absent(name: str) -> list[str]:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "requires", absent)
    assert cli.main(["doctor"]) == 0
    assert "pip install -e ." in capsys.readouterr().out


def test_the_backend_is_named_and_timed(capsys: pytest.CaptureFixture[str]) -> None:
    found = findings(capsys)["rasterizer"]
    assert found["problem"] is None
    assert found["backend"] == "cpu"
    assert found["isa"] in ("avx512", "avx2", "portable")
    assert found["ms_per_step"] > 0


def test_a_backend_that_is_not_built_is_a_finding(monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    from gsopt.raster import api

    def unbuilt(name: str) -> None:
        raise MissingDependency("not built, got nothing. Build it.")

    monkeypatch.setattr(api, "make_backend", unbuilt)
    assert findings(capsys)["rasterizer"]["problem"] == "not built, got nothing. Build it."
    assert cli.main(["doctor"]) == 0
    assert "none: not built" in capsys.readouterr().out


def test_weights_that_a_variable_names_wrongly_are_a_finding(monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("GSOPT_LPIPS_VGG", "/no/such/file.npz")
    found = findings(capsys)["lpips_vgg"]
    assert found["path"] is None
    assert "/no/such/file.npz" in found["problem"]


def test_a_gpu_that_cannot_be_used_is_a_finding_with_its_pip_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("torch.version.cuda", None)
    assert "pip install torch" in findings(capsys)["gpu"]["problem"]
    assert cli.main(["doctor"]) == 0
    assert "none: `backend` is cuda, but this torch" in capsys.readouterr().out


def test_a_gpu_is_named_and_timed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    runtime = SimtRuntime()
    runtime.about = {"device": "Pretended", "arch": "sm_90", "library": "libnvrtc 13.0", "compile_seconds": "2.50"}
    monkeypatch.setattr("gsopt.raster.device.gpu.gpu_runtime", lambda device: runtime)
    monkeypatch.setattr(doctor, "GAUSSIANS", 200)
    found = findings(capsys)["gpu"]
    assert (found["device"], found["arch"], found["library"]) == ("Pretended", "sm_90", "libnvrtc 13.0")
    assert found["compile_seconds"] == 2.5
    assert found["ms_per_step"] > 0
    assert cli.main(["doctor"]) == 0
    assert "Pretended, sm_90" in capsys.readouterr().out


def test_apples_gpu_is_named_and_timed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(doctor, "GAUSSIANS", 20)
    with fake_mps():
        found = findings(capsys)["gpu"]
    assert (found["arch"], found["problem"]) == ("Metal", None)
    assert found["device"].endswith("(mps:0)")
    assert "compile_shader" in found["library"]
    assert found["ms_per_step"] > 0
