#!/usr/bin/env python3
"""Pose graphs of real paths with simulated drift and loops, and what gtsam makes of them on one thread.

    pip install gtsam numpy
    python3 core/benches/pose_graph/peers.py POSES.txt LOOPS GRAPH.txt     POSES as KITTI writes them: 12 numbers a line
    cargo xtask bench pose-graph -- GRAPH.txt ...                          our figures on the same graphs

Noise as in published Sim(3) benchmarks: rotation 0.05 deg, translation 1 % of the step + 5 mm, scale 0.1 % and a creep
of 0.03 % per step. The file has, a line each: `truth x y z`, `odometry tx ty tz qx qy qz qw scale` of the step to the
next node, `loop i j` with the same numbers, and `sigmas odometry|loop rad m log_scale`."""
import os
import sys
import time

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["TBB_NUM_THREADS"] = "1"
import gtsam
import numpy as np

ODOMETRY = [np.radians(0.05), 0.02, 1e-3]
LOOP = [np.radians(0.3), 0.05, 5e-3]
NEAR_M = 4.0
APART = 300
rng = np.random.default_rng(0)


def rotation(omega):
    return gtsam.Rot3.Expmap(omega).matrix()


def inverse(t):
    m = np.eye(4)
    m[:3, :3] = t[:3, :3].T
    m[:3, 3] = -t[:3, :3].T @ t[:3, 3]
    return m


def noisy(t, sigma_rad, sigma_m, sigma_scale, creep):
    m = t.copy()
    m[:3, :3] = t[:3, :3] @ rotation(rng.normal(0, sigma_rad, 3))
    m[:3, 3] = t[:3, 3] * (1 + rng.normal(0, 0.01)) + rng.normal(0, sigma_m, 3)
    return m, float(np.exp(rng.normal(0, sigma_scale) + creep))


def read(path):
    poses = []
    for line in open(path):
        t = np.vstack([np.array(line.split(), float).reshape(3, 4), [0, 0, 0, 1]])
        u, _, v = np.linalg.svd(t[:3, :3])
        t[:3, :3] = u @ v
        poses.append(t)
    return poses


def simulate(truth, n_loops):
    places = np.array([t[:3, 3] for t in truth])
    near = []
    for i in range(APART + 5, len(truth), 5):
        d = np.linalg.norm(places[: i - APART] - places[i], axis=1)
        j = int(np.argmin(d))
        if d[j] < NEAR_M:
            near.append((i, j))
    odometry = [(k, k + 1) + noisy(inverse(truth[k]) @ truth[k + 1], ODOMETRY[0], 0.005, 1e-3, 3e-4) for k in range(len(truth) - 1)]
    chosen = [near[k] for k in np.linspace(0, len(near) - 1, min(n_loops, len(near))).astype(int)] if near else []
    return odometry, [(i, j) + noisy(inverse(truth[i]) @ truth[j], *LOOP, 0) for i, j in chosen]


def numbers(t, scale):
    q = gtsam.Rot3(np.ascontiguousarray(t[:3, :3])).toQuaternion()
    return " ".join("%.17g" % x for x in [*t[:3, 3], q.x(), q.y(), q.z(), q.w(), scale])


def store(path, truth, odometry, loops):
    with open(path, "w") as f:
        for name, sigmas in (("odometry", ODOMETRY), ("loop", LOOP)):
            f.write("sigmas %s %.17g %.17g %.17g\n" % (name, *sigmas))
        f.writelines("truth %.17g %.17g %.17g\n" % tuple(t[:3, 3]) for t in truth)
        f.writelines("odometry %s\n" % numbers(m, s) for _, _, m, s in odometry)
        f.writelines("loop %d %d %s\n" % (i, j, numbers(m, s)) for i, j, m, s in loops)


def similarity(t, scale):
    """gtsam maps x to scale * (R x + t)."""
    return gtsam.Similarity3(gtsam.Rot3(np.ascontiguousarray(t[:3, :3])), t[:3, 3] / scale, scale)


def graph(odometry, loops):
    g, v, at = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.Similarity3()
    v.insert(0, at)
    g.add(gtsam.PriorFactorSimilarity3(0, at, gtsam.noiseModel.Isotropic.Sigma(7, 1e-6)))
    for edges, s in ((odometry, ODOMETRY), (loops, LOOP)):
        model = gtsam.noiseModel.Diagonal.Sigmas(np.array([s[0]] * 3 + [s[1]] * 3 + [s[2]]))
        for i, j, m, scale in edges:
            g.add(gtsam.BetweenFactorSimilarity3(i, j, similarity(m, scale), model))
    for _, j, m, scale in odometry:
        at = at * similarity(m, scale)
        v.insert(j, at)
    return g, v


def ate(places, truth):
    x, y = places - places.mean(0), np.array([t[:3, 3] for t in truth])
    y = y - y.mean(0)
    u, d, v = np.linalg.svd(y.T @ x)
    s = np.array([1, 1, np.sign(np.linalg.det(u @ v))])
    scale = (d * s).sum() / (x**2).sum()
    return float(np.sqrt(((scale * (u * s @ v @ x.T).T - y) ** 2).sum(1).mean()))


def places(values, n):
    at = [values.atSimilarity3(k) for k in range(n)]
    return np.array([s.scale() * np.array(s.translation()) for s in at])


def main():
    truth = read(sys.argv[1])
    odometry, loops = simulate(truth, int(sys.argv[2]))
    store(sys.argv[3], truth, odometry, loops)
    times = []
    for _ in range(5):
        g, v = graph(odometry, loops)
        optimizer = gtsam.LevenbergMarquardtOptimizer(g, v, gtsam.LevenbergMarquardtParams())
        start = time.process_time()
        found = optimizer.optimize()
        times.append((time.process_time() - start) * 1e3)
    n = len(truth)
    print("%s: %d nodes, %d loops, ATE %.3f -> %.3f m, %d iterations, %.1f (%.1f) ms, cost %.2f" % (
        sys.argv[1], n, len(loops), ate(places(v, n), truth), ate(places(found, n), truth),
        optimizer.iterations(), np.median(times), min(times), 2 * g.error(found)))


main()
