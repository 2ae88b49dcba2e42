"""GTSAM's Levenberg-Marquardt on g2o files: python gtsam_pose_graph.py REPEATS FILE... (pip install gtsam)

Prints one JSON object a file: poses, half of chi squared before and after, iterations, milliseconds of each solve.
The first pose is held by a tight prior, as it is held by ours.
"""

import json
import sys
import time

import gtsam
import numpy as np

for path in sys.argv[2:]:
    graph, start = gtsam.readG2o(path, True)
    graph = gtsam.NonlinearFactorGraph(graph)
    first = min(start.keys())
    noise = gtsam.noiseModel.Diagonal.Variances(np.full(6, 1e-6))
    graph.add(gtsam.PriorFactorPose3(first, start.atPose3(first), noise))
    milliseconds = []
    for _ in range(int(sys.argv[1])):
        began = time.perf_counter()
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, start, gtsam.LevenbergMarquardtParams())
        found = optimizer.optimize()
        milliseconds.append(1e3 * (time.perf_counter() - began))
    print(
        json.dumps(
            {
                "file": path,
                "poses": start.size(),
                "before": graph.error(start),
                "after": graph.error(found),
                "iterations": optimizer.iterations(),
                "milliseconds": milliseconds,
            }
        ),
        flush=True,
    )
