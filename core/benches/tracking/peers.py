#!/usr/bin/env python3
"""OpenCV and PoseLib on the problems of `cargo xtask bench tracking`, one thread.

    pip install opencv-python-headless poselib numpy
    python3 core/benches/tracking/peers.py pictures RECORDING/images DIR     two neighbouring pictures, at 1241x376
    cargo xtask bench tracking -- --folder DIR                               our figures; stores the problems
    python3 core/benches/tracking/peers.py run DIR [N]                       theirs, of the first N problems

Milliseconds of one thread: median (fastest)."""
import os
import sys
import time

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
import cv2
import numpy as np
import poselib

cv2.setNumThreads(1)
FOLDER = sys.argv[3] if sys.argv[1] == "pictures" else sys.argv[2]
ROUNDS = 30
K = np.array([[718.856, 0, 607.19], [0, 718.856, 185.22], [0, 0, 1.0]])
CAMERA = {"model": "PINHOLE", "width": 1241, "height": 376, "params": [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]}
ROTATION = cv2.Rodrigues(np.array([0.01, 0.03, -0.005]))[0]
TRANSLATION = -ROTATION @ np.array([0.05, 0.02, 1.0])


def timed(rounds, work):
    times, results = [], []
    for i in rounds:
        start = time.thread_time()
        results.append(work(i))
        times.append((time.thread_time() - start) * 1e3)
    return "%.3f (%.3f)" % (np.median(times), min(times)), results


def rotation_error(found):
    return np.degrees(np.arccos(np.clip((np.trace(found.T @ ROTATION) - 1) / 2, -1, 1)))


def direction_error(found):
    cosine = found.ravel() @ TRANSLATION / np.linalg.norm(found) / np.linalg.norm(TRANSLATION)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def images():
    a, b, moved = (np.fromfile("%s/%s.gray" % (FOLDER, name), np.uint8).reshape(376, 1241)
                   for name in ("a", "b", "moved"))
    table = np.loadtxt(FOLDER + "/points.txt").astype(np.float32)
    points, truth = np.ascontiguousarray(table[:, :2]).reshape(-1, 1, 2), table[:, 2:]
    print("\n| 1241x376, %d points | ms | accuracy |\n|---|---:|---|" % len(points))
    ms, _ = timed(range(ROUNDS), lambda _: cv2.buildOpticalFlowPyramid(a, (21, 21), 3, withDerivatives=False))
    print("| buildOpticalFlowPyramid, 4 levels, without derivatives | %s | - |" % ms)
    ms, found = timed(range(ROUNDS), lambda _: cv2.goodFeaturesToTrack(a, 1000, 0.01, 10))
    print("| goodFeaturesToTrack 1000, quality 0.01, distance 10 | %s | %d found |" % (ms, len(found[0])))
    for name, criteria in (("30 steps, 0.01 px", (3, 30, 0.01)), ("10 steps, 0.03 px", (3, 10, 0.03))):
        search = lambda target: cv2.calcOpticalFlowPyrLK(
            a, target, points, None, winSize=(21, 21), maxLevel=3, criteria=criteria)
        ms, results = timed(range(ROUNDS), lambda _: search(b))
        target, status, _ = search(moved)
        errors = np.linalg.norm(target[:, 0] - truth, axis=1)[status[:, 0] == 1]
        print("| calcOpticalFlowPyrLK 21x21, 4 levels, %s (pyramids included) | %s | %d found; moved picture: "
              "%d found, %d within 0.5 px, median error %.4f px |"
              % (name, ms, results[0][1].sum(), len(errors), (errors < 0.5).sum(), np.median(errors)))


def matching():
    a, b = (np.fromfile("%s/%s.gray" % (FOLDER, name), np.uint8).reshape(376, 1241) for name in ("a", "b"))
    orb = cv2.ORB_create(2000)
    print("\n| 1241x376 | ms | found |\n|---|---:|---:|")
    ms, results = timed(range(ROUNDS), lambda _: orb.detectAndCompute(a, None))
    print("| ORB 2000, corners and descriptors | %s | %d |" % (ms, len(results[0][0])))
    first, second = results[0][1], orb.detectAndCompute(b, None)[1]
    ms, results = timed(range(ROUNDS), lambda _: cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(first, second))
    print("| BFMatcher %d x %d of 256 bits, mutual | %s | %d |" % (len(first), len(second), ms, len(results[0])))


def essential(name, problems, solve):
    ms, results = timed(range(len(problems)), lambda i: solve(problems[i][:, :2].copy(), problems[i][:, 2:4].copy()))
    print("| %s | %s | %.4f | %.3f |" % (name, ms, np.median([rotation_error(r) for r, _ in results]),
                                        np.median([direction_error(t) for _, t in results])), flush=True)


def opencv_essential(method):
    def solve(p, q):
        found, mask = cv2.findEssentialMat(p, q, K, method, 0.999, 1.0)
        _, r, t, _ = cv2.recoverPose(found[:3], p, q, K, mask=mask)
        return r, t
    return solve


def poselib_essential(p, q):
    options = {"max_epipolar_error": 1.0, "success_prob": 0.999, "min_iterations": 100, "max_iterations": 10000}
    pose, _ = poselib.estimate_relative_pose(p, q, CAMERA, CAMERA, options, {})
    return pose.R, pose.t


def transfer_error(found, points):
    exact = points @ ROTATION.T + TRANSLATION
    moved = (points / points[:, 2:]) @ K.T @ found.T
    exact_px = (exact / exact[:, 2:]) @ K.T
    return np.mean(np.linalg.norm(moved[:, :2] / moved[:, 2:] - exact_px[:, :2], axis=1))


def homography(name, problems, solve):
    ms, results = timed(range(len(problems)), lambda i: solve(problems[i][:, :2].copy(), problems[i][:, 2:4].copy()))
    errors = [transfer_error(h, p[:, 4:]) for h, p in zip(results, problems)]
    print("| %s | %s | %.3f |" % (name, ms, np.median(errors)), flush=True)


def opencv_homography(p, q):
    return cv2.findHomography(p, q, cv2.USAC_MAGSAC, 2.0, maxIters=1000, confidence=0.999)[0]


def poselib_homography(p, q):
    return poselib.estimate_homography(p, q, {"max_reproj_error": 2.0, "success_prob": 0.999}, {})[0]


def absolute(name, problems, solve):
    ms, results = timed(range(len(problems)), lambda i: solve(problems[i][:, 2:4].copy(), problems[i][:, 4:].copy()))
    print("| %s | %s | %.4f | %.4f |" % (name, ms, np.median([rotation_error(r) for r, _ in results]),
                                        np.median([np.linalg.norm(t.ravel() - TRANSLATION) for _, t in results])),
          flush=True)


def opencv_absolute(q, points):
    _, r, t, _ = cv2.solvePnPRansac(points, q, K, None, flags=cv2.SOLVEPNP_AP3P, reprojectionError=2.0,
                                    confidence=0.999, iterationsCount=1000)
    return cv2.Rodrigues(r)[0], t


def poselib_absolute(q, points):
    options = {"max_reproj_error": 2.0, "min_iterations": 100, "success_prob": 0.999}
    pose, _ = poselib.estimate_absolute_pose(q, points, CAMERA, options, {})
    return pose.R, pose.t


def store_pictures(recording):
    os.makedirs(FOLDER, exist_ok=True)
    for name, number in (("a", 10), ("b", 11)):
        picture = cv2.imread("%s/%06d.jpg" % (recording, number), 0)
        cv2.resize(picture, (1241, 376), interpolation=cv2.INTER_LINEAR).tofile("%s/%s.gray" % (FOLDER, name))


def main():
    if sys.argv[1] == "pictures":
        return store_pictures(sys.argv[2])
    print("OpenCV %s, PoseLib %s" % (cv2.__version__, poselib.__version__))
    images()
    matching()
    n_problems = int(sys.argv[3]) if len(sys.argv) > 3 else None
    stored, planes = ({ratio: np.fromfile("%s/%s_%d.f64" % (FOLDER, name, ratio)).reshape(-1, 1000, 7)[:n_problems]
                       for ratio in (30, 60)} for name in ("two_views", "plane"))
    print("\n| relative pose | ms | rotation error, deg | direction error, deg |\n|---|---:|---:|---:|")
    for ratio, problems in stored.items():
        label = "%d %% outliers, %d problems: " % (ratio, len(problems))
        essential(label + "OpenCV USAC_MAGSAC", problems, opencv_essential(cv2.USAC_MAGSAC))
        essential(label + "PoseLib", problems, poselib_essential)
    print("\n| homography | ms | mean transfer error, px |\n|---|---:|---:|")
    for ratio, problems in planes.items():
        label = "%d %% outliers, %d problems: " % (ratio, len(problems))
        homography(label + "OpenCV USAC_MAGSAC", problems, opencv_homography)
        homography(label + "PoseLib", problems, poselib_homography)
    print("\n| pose from landmarks | ms | rotation error, deg | position error, m |\n|---|---:|---:|---:|")
    for ratio, problems in stored.items():
        label = "%d %% outliers, %d problems: " % (ratio, len(problems))
        absolute(label + "OpenCV AP3P", problems, opencv_absolute)
        absolute(label + "PoseLib", problems, poselib_absolute)


main()
