"""Writes float64 references (one .npz per scene) as the files that `splat/cpu/tests/golden.rs` reads.

    python3 runtime/tests/convert_golden.py ../shared/golden/splat /tmp/golden
    KILOGS_GOLDEN=/tmp/golden cargo nextest run -p kilogs --lib golden

tests/golden holds the six smaller scenes already; this writes all that are not there.
"""

import pathlib
import struct
import sys

import numpy as np

ARRAYS = (
    "means quats_wxyz scales opacities colors radii means2d depths conics image_rgbd alpha grad_image_rgbd grad_alpha "
    "grad_means grad_quats grad_scales grad_opacities grad_colors"
).split()


def convert(scene):
    """One scene as bytes: magic, n, width, height, then the camera and all arrays as little-endian f32."""
    k = scene["K"]
    camera = [*scene["camera_from_world"].ravel(), k[0, 0], k[1, 1], k[0, 2], k[1, 2]]
    header = struct.pack("<4sIII", b"KGLD", len(scene["means"]), int(scene["width"]), int(scene["height"]))
    return header + b"".join(np.asarray(a, dtype="<f4").tobytes() for a in [camera, *(scene[n] for n in ARRAYS)])


def main():
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    source, out = map(pathlib.Path, sys.argv[1:])
    out.mkdir(parents=True, exist_ok=True)
    committed = pathlib.Path(__file__).parent / "golden"
    for path in sorted(source.glob("*.npz")):
        if not (committed / f"{path.stem}.bin").exists():
            (out / f"{path.stem}.bin").write_bytes(convert(np.load(path)))
            print(out / f"{path.stem}.bin")


main()
