"""Makes the pictures of the pages anew: `python docs/make_pictures.py ISABEL.h5` (`make pictures`).

They are those of docs/images that show a volume: of the landing page from a file of real data, by
the defaults of `fhash encode` and `fhash render`; of the first hour from `fhash demo`; the gallery.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.gallery import Pair, compare
from fhash_formats.readers.registry import open_series

IMAGES = Path(__file__).parent / "images"
QUALITIES = (40, 50, 60)
"""PSNR in dB of the files whose slices are compared."""


def run(*words: object) -> None:
    """Run fhash."""
    subprocess.run([Path(sys.executable).with_name("fhash"), *map(str, words), "-q"], check=True)


def qualities(data: Path, folder: Path) -> None:
    """Draw a slice of the source and of files of 40, 50 and 60 dB, with their errors and bytes."""
    pairs = []
    with open_series(data) as series:
        step, level = 2 * series.shape[0] // 3, series.shape[1] // 3
        original = series.read(step)[level].astype(float)
        quantity = f"{series.name} [{series.units}]" if series.units else series.name
    for quality in QUALITIES:
        path = folder / f"{quality}.fhz"
        report = fhash_codec.encode(data, path, EncodeConfig(psnr=float(quality)))
        with fhash_codec.open(path) as volume:
            decoded = volume.read(step)[level].astype(float)
        size = f"{report['bytes'] / 1000:,.0f} kB, {report['ratio']:.0f} times smaller"
        label = f"{quality} dB: {size}"
        pairs.append(Pair(label=label, original=original, decoded=decoded))
    title = f"{data.stem}: one slice at {', '.join(map(str, QUALITIES))} dB"
    subtitle = f"step {step}, level {level}; {report['raw_bytes'] / 1e6:.1f} MB as numbers"
    compare(pairs, title=title, subtitle=subtitle, quantity=quantity).save(IMAGES / "quality.png")


def main(data: Path) -> None:
    """Make every picture."""
    with TemporaryDirectory() as made:
        folder = Path(made)
        run("encode", data, "-o", folder / "landing.fhz")
        run("render", folder / "landing.fhz", "-o", IMAGES / "landing.png", "--force")
        qualities(data, folder)
        run("demo", "-o", folder / "demo")
        (folder / "demo/vortex.png").replace(IMAGES / "vortex.png")
        run("encode", folder / "demo/vortex.h5", "-o", folder / "run.fhz", "--max-error", 0.01)
        words = ("--t", 12, "--size", "800x700", "--cmap", "turbo", "--force")
        run("render", folder / "run.fhz", "-o", IMAGES / "first-render.png", *words)
    run("demo", "--gallery", IMAGES.parent / "gallery", "--force")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
