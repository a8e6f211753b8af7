"""The shell beside other renderers."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from blobs import CAMERAS, field, task

from fhash_bench.pictures import shell as module
from fhash_bench.pictures import shell as orbit
from fhash_bench.pictures.shell import (
    OsprayPeer,
    beside_shell,
    find_ospray,
    load_ospray,
    shell,
)
from fhash_bench.pictures.shell import (
    orbit as orbit_orbit,
)
from fhash_formats.errors import InputError, MissingDependencyError


def test_vtk_draws_the_shell_unlit_and_lit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(orbit, "SIDE", 24)
    found = beside_shell(1, 24)
    assert [(pair.scene, pair.shaded) for pair in found] == [
        ("shell of 24^3", False),
        ("shell of 24^3", True),
    ]
    for pair in found:
        assert pair.peer.startswith("VTK 9")
        assert pair.ours_ms > 0
        assert pair.peer_ms >= 0
        assert pair.ratio == pair.peer_ms / pair.ours_ms
        assert pair.psnr is None or pair.psnr > 20


def test_without_any_peer_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> None:
        raise MissingDependencyError("comparing with VTK needs it: pip install 'fhash[bench]'")

    monkeypatch.setattr(module, "require_vtk", missing)
    with pytest.raises(MissingDependencyError, match="pip install"):
        beside_shell(1, 16)


def test_a_shell_lies_about_the_middle() -> None:
    values = shell(41)
    assert values.shape == (41, 41, 41)
    assert values.dtype == np.float32
    assert values.max() > 0.9
    assert values[20, 20, 20] == values[0, 0, 0] == pytest.approx(0, abs=1e-6)


def test_pictures_with_kept_bricks_take_the_same_samples() -> None:
    unlit, lit = orbit_orbit(2, 24, side=40)
    assert unlit.name == "shell of 40^3, unlit: bricks kept"
    for switch in (unlit, lit):
        assert switch.counters_off == switch.counters_on
        assert switch.off_ms > 0
        assert switch.on_ms > 0
    assert unlit.counters_on["gradients"] == 0 < lit.counters_on["gradients"]


FAKE = r"""
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
typedef void *H;
static FILE *notes;
static char handle[64];
static int next, wide, high;
static float *pixels;
static H made(const char *kind, const char *name) {
    fprintf(notes, "new %s %s\n", kind, name);
    fflush(notes);
    return handle + ++next % 60;
}
int ospInit(int *count, const char **words) {
    notes = fopen(getenv("FAKE_OSPRAY_NOTES"), "w");
    fprintf(notes, "init %d %s\n", *count, words[1]);
    return 0;
}
H ospGetCurrentDevice(void) { return handle; }
int64_t ospDeviceGetProperty(H d, uint32_t which) { return which == 1 ? MAJOR : which; }
const char *ospDeviceGetLastErrorMsg(H d) { return "an error"; }
H ospNewSharedData(const void *data, uint32_t type, uint64_t x, int64_t a, uint64_t y, int64_t b,
                   uint64_t z, int64_t c, void *f, void *g) {
    fprintf(notes, "data %u %d %d %d first %g\n", type, (int)x, (int)y, (int)z, *(float *)data);
    return handle + ++next % 60;
}
H ospNewVolume(const char *name) { return made("volume", name); }
H ospNewTransferFunction(const char *name) { return made("function", name); }
H ospNewCamera(const char *name) { return made("camera", name); }
H ospNewRenderer(const char *name) { return made("renderer", name); }
H ospNewVolumetricModel(H volume) { return made("model", ""); }
H ospNewGroup(void) { return made("group", ""); }
H ospNewInstance(H group) { return made("instance", ""); }
H ospNewWorld(void) { return made("world", ""); }
H ospNewFrameBuffer(int w, int h, uint32_t format, uint32_t channels) {
    wide = w, high = h;
    pixels = calloc(4 * w * h, sizeof(float));
    for (int i = 0; i < w; i++) pixels[4 * i] = 1;  /* the lowest row is red */
    return made("buffer", "");
}
void ospSetParam(H t, const char *name, uint32_t type, const float *v) {
    fprintf(notes, "param %s %u %g %g\n", name, type, v[0], v[1]);
}
void ospSetFloat(H t, const char *name, float v) { fprintf(notes, "float %s %g\n", name, v); }
void ospSetVec3f(H t, const char *name, float x, float y, float z) {
    fprintf(notes, "vector %s %g %g %g\n", name, x, y, z);
}
void ospSetObject(H t, const char *name, H v) { fprintf(notes, "object %s\n", name); }
void ospSetObjectAsData(H t, const char *name, uint32_t type, H v) {
    fprintf(notes, "objects %s %u\n", name, type);
}
void ospCommit(H o) {}
void ospRelease(H o) { fprintf(notes, "release\n"); fflush(notes); }
H ospRenderFrame(H b, H r, H c, H w) { return made("future", ""); }
void ospWait(H f, uint32_t event) { fprintf(notes, "wait %u\n", event); }
const void *ospMapFrameBuffer(H b, uint32_t channel) { return pixels; }
void ospUnmapFrameBuffer(const void *p, H b) {}
"""


def built(folder: Path, source: str, name: str = "libospray.so") -> Path:
    """A shared library of a C source."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler")
    (folder / "fake.c").write_text(source)
    path = folder / name
    subprocess.run([compiler, "-shared", "-fPIC", "-o", path, folder / "fake.c"], check=True)
    return path


def test_ospray_is_given_the_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FAKE_OSPRAY_NOTES", str(tmp_path / "notes"))
    built(tmp_path, FAKE.replace("MAJOR", "3"))
    library, version = load_ospray(find_ospray(str(tmp_path)), 2)
    assert version == "3.2.3"
    asked, values = task(CAMERAS[0], shaded=False, step=0.25), field()[1]
    assert asked.table is not None
    grid = asked.rays.grid
    peer = OsprayPeer(library, values, grid, asked.table, size=(6, 4), step=asked.step)
    peer.look(asked.rays)
    drawn = peer.draw()
    peer.close()
    # The rows of OSPRay begin at the bottom.
    assert drawn.pixels.shape == (4, 6, 3)
    assert drawn.pixels[3, :, 0].tolist() == [255] * 6
    assert not drawn.pixels[:3].any()
    notes = (tmp_path / "notes").read_text().splitlines()
    assert notes[0] == "init 2 --osp:num-threads=2"
    assert "data 6000 {2} {1} {0}".format(*values.shape) in notes[2]
    spacing = np.abs(grid.spacing)
    assert "vector gridSpacing " + " ".join(f"{part:g}" for part in spacing) in notes
    assert f"float volumeSamplingRate {spacing.min() / asked.step:g}" in notes
    assert f"float densityScale {asked.table.extinctions.max():g}" in notes
    assert f"param value 10000 {asked.table.low:g} {asked.table.high:g}" in notes
    assert any(line.startswith("float fovy") for line in notes)
    assert sum(line.startswith("release") for line in notes) > 10
    assert {"new volume structuredRegular", "new renderer scivis"} <= set(notes)


def test_what_is_no_ospray_is_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FAKE_OSPRAY_NOTES", str(tmp_path / "notes"))
    for named in (str(tmp_path), "no_such_module", "json", "a b"):
        with pytest.raises(InputError, match="no OSPRay there"):
            find_ospray(named)
    text = tmp_path / "text.so"
    text.write_text("no library")
    with pytest.raises(InputError, match="cannot be loaded"):
        load_ospray(find_ospray(str(text)), 1)
    other = built(tmp_path, "int other(void) { return 1; }", "other.so")
    with pytest.raises(InputError, match="it has no ospInit, so it is no OSPRay 2 or 3"):
        load_ospray(other, 1)
    old = built(tmp_path, FAKE.replace("MAJOR", "1"), "old.so")
    with pytest.raises(InputError, match=r"OSPRay 1\.2\.3; versions 2 and 3 are known"):
        load_ospray(old, 1)
