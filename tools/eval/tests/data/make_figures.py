#!/usr/bin/env python3
"""Makes the trajectories and images of this folder, and the figures that public packages give for them.

Needs: pip install numpy evo==1.38.1 scikit-image. Run here; writes *_truth.txt, *_estimate.txt, *_camera.pnm, *_rendered.pnm,
figures.json. Everything is drawn from fixed seeds; nothing comes from a recording.
The KITTI segment errors are a direct transcription of the benchmark's definition into numpy, because evo has none.
"""
import json

import numpy as np
from evo.core import metrics, sync
from evo.core.metrics import PoseRelation, Unit
from evo.tools import file_interface
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

LENGTHS_M = [100, 200, 300, 400, 500, 600, 700, 800]


def drive(n, step_m, wiggle, rng):
    """A vehicle that goes forward (z) and turns about y (down) with some pitch and roll."""
    poses, pose = [], np.eye(4)
    for k in range(n):
        poses.append(pose.copy())
        step = np.eye(4)
        turn = wiggle * np.sin(0.05 * k) + 0.002 * rng.standard_normal()
        step[:3, :3] = Rotation.from_euler("yxz", [turn, *(0.001 * rng.standard_normal(2))]).as_matrix()
        step[:3, 3] = [0.01 * rng.standard_normal(), 0.005 * rng.standard_normal(), step_m]
        pose = pose @ step
    return np.array(poses)


def drifted(truth, scale, rotation_noise, rng):
    """The same drive as an odometry with noise and a wrong scale sees it, in another world."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [0.4, -1.1, 0.7]).as_matrix()
    pose[:3, 3] = [12.0, -3.0, 40.0]
    poses = [pose]
    for last, current in zip(truth[:-1], truth[1:]):
        step = np.linalg.inv(last) @ current
        step[:3, :3] = step[:3, :3] @ Rotation.from_rotvec(rotation_noise * rng.standard_normal(3)).as_matrix()
        step[:3, 3] = scale * step[:3, 3] + 0.01 * rng.standard_normal(3)
        poses.append(poses[-1] @ step)
    return np.array(poses)


def write_tum(name, times, poses):
    with open(name, "w") as file:
        for t, pose in zip(times, poses):
            q = Rotation.from_matrix(pose[:3, :3]).as_quat()
            q = -q if q[3] < 0 else q
            file.write(" ".join(f"{v:.9f}" for v in [t, *pose[:3, 3], *q]) + "\n")


def segments(truth, estimate):
    """KITTI odometry: starts at every tenth pose, ends at the first pose beyond the length; no alignment."""
    centers = truth[:, :3, 3]
    driven = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(centers, axis=0), axis=1))])
    translation, rotation = [], []
    for first in range(0, len(truth), 10):
        for length in LENGTHS_M:
            beyond = np.flatnonzero(driven > driven[first] + length)
            if len(beyond) == 0:
                continue
            last = beyond[0]
            delta_truth = np.linalg.inv(truth[first]) @ truth[last]
            delta_estimate = np.linalg.inv(estimate[first]) @ estimate[last]
            error = np.linalg.inv(delta_estimate) @ delta_truth
            translation.append(np.linalg.norm(error[:3, 3]) / length)
            rotation.append(Rotation.from_matrix(error[:3, :3]).magnitude() / length)
    if not translation:
        return None, None, 0
    return 100 * float(np.mean(translation)), 100 * float(np.rad2deg(np.mean(rotation))), len(translation)


def rpe(truth, estimate, relation, delta):
    metric = metrics.RPE(relation, delta=delta, delta_unit=Unit.frames, all_pairs=True)
    metric.process_data((truth, estimate))
    return metric.get_statistic(metrics.StatisticsType.rmse)


def judge(name):
    truth = file_interface.read_tum_trajectory_file(f"{name}_truth.txt")
    estimate = file_interface.read_tum_trajectory_file(f"{name}_estimate.txt")
    truth, estimate = sync.associate_trajectories(truth, estimate, max_diff=0.01)
    percent, deg_per_100m, n_segments = segments(np.array(truth.poses_se3), np.array(estimate.poses_se3))
    figures = {
        "name": name,
        "n": truth.num_poses,
        "rpe_translation_m": rpe(truth, estimate, PoseRelation.translation_part, 1),
        "rpe_rotation_deg": rpe(truth, estimate, PoseRelation.rotation_angle_deg, 1),
        "rpe10_translation_m": rpe(truth, estimate, PoseRelation.translation_part, 10),
        "rpe10_rotation_deg": rpe(truth, estimate, PoseRelation.rotation_angle_deg, 10),
        "segment_translation_percent": percent,
        "segment_rotation_deg_per_100m": deg_per_100m,
        "n_segments": n_segments,
    }
    for key, with_scale in [("se3", False), ("sim3", True)]:
        aligned = file_interface.read_tum_trajectory_file(f"{name}_estimate.txt")
        reference = file_interface.read_tum_trajectory_file(f"{name}_truth.txt")
        reference, aligned = sync.associate_trajectories(reference, aligned, max_diff=0.01)
        _, _, scale = aligned.align(reference, correct_scale=with_scale)
        ape = metrics.APE(PoseRelation.translation_part)
        ape.process_data((reference, aligned))
        figures[f"ate_{key}_m"] = ape.get_statistic(metrics.StatisticsType.rmse)
        figures[f"ate_{key}_max_m"] = ape.get_statistic(metrics.StatisticsType.max)
        if with_scale:
            figures["scale"] = float(scale)
    return figures


def trajectories():
    # A drive long enough for every segment length, thinned so that the file stays small.
    rng = np.random.default_rng(1)
    truth = drive(620, 1.5, 0.02, rng)
    times = 0.1 * np.arange(len(truth))
    write_tum("long_truth.txt", times, truth)
    write_tum("long_estimate.txt", times, drifted(truth, 0.92, 2e-4, rng))
    # Half as many estimates as truth, jittered times, some missing, a scale that is far off.
    rng = np.random.default_rng(2)
    truth = drive(200, 0.8, 0.05, rng)
    times = 1000.0 + 0.05 * np.arange(len(truth))
    estimate = drifted(truth, 2.5, 1e-3, rng)
    keep = np.arange(0, 200, 2)[rng.random(100) > 0.1]
    write_tum("sparse_truth.txt", times, truth)
    write_tum("sparse_estimate.txt", (times + rng.uniform(-0.012, 0.012, len(times)))[keep], estimate[keep])
    # More estimates than truth.
    rng = np.random.default_rng(3)
    truth = drive(150, 1.0, 0.03, rng)
    times = 0.1 * np.arange(len(truth))
    write_tum("dense_truth.txt", times[::3], truth[::3])
    write_tum("dense_estimate.txt", times + 0.004, drifted(truth, 1.0, 5e-4, rng))
    return [judge(name) for name in ["long", "sparse", "dense"]]


def write_pnm(name, image):
    kind = b"P5" if image.ndim == 2 else b"P6"
    with open(name, "wb") as file:
        file.write(kind + f"\n{image.shape[1]} {image.shape[0]}\n255\n".encode() + image.tobytes())


def images():
    figures = []
    for name, shape, seed in [("grey", (37, 53), 4), ("color", (29, 41, 3), 5)]:
        rng = np.random.default_rng(seed)
        sigma = (2, 2) if len(shape) == 2 else (2, 2, 0)
        camera = gaussian_filter(rng.random(shape), sigma)
        camera = (camera - camera.min()) / np.ptp(camera)
        rendered = np.clip(0.9 * gaussian_filter(camera, sigma) + 0.05 + 0.03 * rng.standard_normal(shape), 0, 1)
        camera, rendered = (np.round(255 * image).astype(np.uint8) for image in (camera, rendered))
        write_pnm(f"{name}_camera.pnm", camera)
        write_pnm(f"{name}_rendered.pnm", rendered)
        x, y = camera / 255.0, rendered / 255.0
        ssim = structural_similarity(
            x, y, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1.0,
            channel_axis=None if len(shape) == 2 else 2,
        )
        figures.append({"name": name, "psnr_db": float(peak_signal_noise_ratio(x, y, data_range=1.0)), "ssim": float(ssim)})
    return figures


with open("figures.json", "w") as file:
    json.dump({"trajectories": trajectories(), "images": images()}, file, indent=1)
    file.write("\n")
