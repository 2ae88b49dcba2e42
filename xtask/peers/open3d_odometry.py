"""Open3D's RGB-D odometry and TSDF fusion on masked frames: python open3d_odometry.py FOLDER OUT [SPACING]
(pip install open3d)

FOLDER has rgb/, depth/ (millimetres, 0 outside of the object), and cam_K.txt. Each frame is aligned with the one before
it (three scales, hybrid of photometric and geometric error; the legacy pipeline, since the tensor one with its default
parameters lost a turned object within six frames) and fused into a voxel block grid at the pose found. Writes OUT/ob_in_cam/<frame>.txt (object = first camera), OUT/mesh.ply, and OUT/peer.json with the
seconds and the success of each frame. Reading files is not timed.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np
import open3d as o3d
import open3d.core as o3c

odometry = o3d.pipelines.odometry
folder, out = Path(sys.argv[1]), Path(sys.argv[2])
spacing = float(sys.argv[3]) if len(sys.argv) > 3 else 0.0025
DEPTH_SCALE, DEPTH_MAX, TRUNCATION = 1000.0, 10.0, 4.0
intrinsics = o3c.Tensor(np.loadtxt(folder / "cam_K.txt").reshape(3, 3))
names = sorted(path.stem for path in (folder / "rgb").glob("*.png"))
(out / "ob_in_cam").mkdir(parents=True, exist_ok=True)
grid = o3d.t.geometry.VoxelBlockGrid(
    ("tsdf", "weight"), (o3c.float32, o3c.float32), ((1), (1)), spacing, 16, 4000, o3c.Device("CPU:0")
)


def read(name):
    color = o3d.t.io.read_image(str(folder / "rgb" / f"{name}.png"))
    depth = o3d.t.io.read_image(str(folder / "depth" / f"{name}.png"))
    return color, depth


height, width = (int(size) for size in read(names[0])[1].as_tensor().shape[:2])
matrix = intrinsics.numpy()
camera = o3d.camera.PinholeCameraIntrinsic(
    width, height, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
)
option = odometry.OdometryOption(depth_diff_max=0.03, depth_min=0.05, depth_max=DEPTH_MAX)
hybrid = odometry.RGBDOdometryJacobianFromHybridTerm()

cam_from_obj = np.eye(4)
before = None
seconds, tracked = [], []
for name in names:
    color, depth = read(name)
    began = time.perf_counter()
    frame = o3d.geometry.RGBDImage.create_from_color_and_depth(
        color.to_legacy(), depth.to_legacy(), depth_scale=DEPTH_SCALE, depth_trunc=DEPTH_MAX
    )
    success = True
    if before is not None:
        success, motion, _ = odometry.compute_rgbd_odometry(
            before, frame, camera, np.eye(4), hybrid, option
        )
        success = bool(success) and bool(np.isfinite(motion).all())
        if success:
            cam_from_obj = motion @ cam_from_obj
    if success and depth.as_tensor().max().item() > 0:
        # A frame that could not be aligned is no reference for the next one.
        before = frame
        extrinsics = o3c.Tensor(cam_from_obj)
        blocks = grid.compute_unique_block_coordinates(
            depth, intrinsics, extrinsics, DEPTH_SCALE, DEPTH_MAX, TRUNCATION
        )
        grid.integrate(blocks, depth, intrinsics, extrinsics, DEPTH_SCALE, DEPTH_MAX, TRUNCATION)
    seconds.append(time.perf_counter() - began)
    tracked.append(success)
    rows = "\n".join(" ".join(f"{value:.9g}" for value in row) for row in cam_from_obj)
    (out / "ob_in_cam" / f"{name}.txt").write_text(rows + "\n")

mesh = grid.extract_triangle_mesh(weight_threshold=1.0)
vertices = mesh.vertex.positions.numpy().astype("<f4")
triangles = mesh.triangle.indices.numpy()
faces = np.empty(len(triangles), dtype=[("count", "u1"), ("corners", "<i4", 3)])
faces["count"], faces["corners"] = 3, triangles
if len(triangles) > 0:
    with open(out / "mesh.ply", "wb") as file:
        header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
        header += [f"property float {axis}" for axis in "xyz"]
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
        file.write(("\n".join(header) + "\n").encode())
        file.write(vertices.tobytes())
        file.write(faces.tobytes())
(out / "peer.json").write_text(json.dumps({"seconds": seconds, "tracked": tracked, "version": o3d.__version__}))
