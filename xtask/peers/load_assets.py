"""Loads the assets of an exported run in trimesh, MuJoCo and PyBullet: load_assets.py OUT

Prints what each program makes of them; exits with 1 when a file doesn't load or two disagree.
"""

import json
import os
import sys


def close(name, a, b, tolerance):
    worst = max(abs(x - y) for x, y in zip(a, b))
    print(f"  {name}: {[round(float(v), 5) for v in a]} (differs by {worst:.2g})")
    if worst > tolerance:
        raise AssertionError(f"{name}: {list(a)} is not {list(b)}")


def load_trimesh(out, report):
    import numpy
    import trimesh

    extents = {}
    for name in ("mesh.glb", "textured.obj", "textured.ply", "mesh.stl"):
        path = os.path.join(out, name)
        if not os.path.exists(path):
            continue
        scene = trimesh.load(path)
        mesh = scene.to_geometry() if isinstance(scene, trimesh.Scene) else scene
        texture = getattr(getattr(mesh.visual, "material", None), "baseColorTexture", None)
        texture = texture or getattr(getattr(mesh.visual, "material", None), "image", None)
        size = f", texture {texture.size[0]}x{texture.size[1]}" if texture is not None else ""
        print(f"  {name}: {len(mesh.vertices)} vertices, {len(mesh.faces)} faces{size}")
        if len(mesh.faces) != report["faces"]:
            raise AssertionError(f"{name}: {len(mesh.faces)} faces, export.json says {report['faces']}")
        extents[name] = sorted(mesh.extents)
    first = next(iter(extents.values()))
    for name, extent in extents.items():
        close(f"extents of {name}", extent, first, 1e-5)
    if report["mass"] and report["watertight"]:
        mesh = trimesh.load(os.path.join(out, "textured.ply"))
        mesh.density = report["mass"]["mass_kg"] / report["mass"]["volume_m3"]
        close("mass", [mesh.mass], [report["mass"]["mass_kg"]], 1e-4)
        close("centre of mass", mesh.center_mass, report["mass"]["center_of_mass_m"], 1e-5)
        inertia = numpy.array(report["mass"]["inertia_kg_m2"])
        close("inertia", mesh.moment_inertia.ravel(), inertia.ravel(), 1e-3 * inertia.max())


def load_mujoco(out, report):
    import mujoco
    import numpy

    for name in ("object.xml", "object.urdf"):
        model = mujoco.MjModel.from_xml_path(os.path.join(out, "sim", name))
        print(f"  {name}: {model.nbody} bodies, {model.ngeom} geoms, {model.nmesh} meshes, {model.ntex} textures")
    spec = mujoco.MjSpec.from_file(os.path.join(out, "sim", "object.xml"))
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.1], pos=[0, 0, -0.3])
    model = spec.compile()
    body = model.body("object").id
    close("mass", [model.body_mass[body]], [report["mass"]["mass_kg"]], 1e-6)
    close("centre of mass", model.body_ipos[body], report["mass"]["center_of_mass_m"], 1e-6)
    wanted = numpy.sort(numpy.linalg.eigvalsh(numpy.array(report["mass"]["inertia_kg_m2"])))
    close("principal inertia", numpy.sort(model.body_inertia[body]), wanted, 1e-3 * wanted.max())
    data = mujoco.MjData(model)
    for _ in range(3000):
        mujoco.mj_step(model, data)
    print(f"  after {data.time:.0f} s of falling: z {data.xipos[body][2]:.3f} m, "
          f"speed {numpy.linalg.norm(data.qvel[:3]):.4f} m/s, {data.ncon} contacts")
    if not (numpy.isfinite(data.qpos).all() and -0.3 < data.xipos[body][2] < 0.3 and data.ncon > 0):
        raise AssertionError("the body doesn't come to rest on the plane")


def load_pybullet(out, report):
    import pybullet

    pybullet.connect(pybullet.DIRECT)
    pybullet.setGravity(0, 0, -9.81)
    plane = pybullet.createCollisionShape(pybullet.GEOM_PLANE)
    pybullet.createMultiBody(0, plane, basePosition=[0, 0, -0.3])
    body = pybullet.loadURDF(os.path.join(out, "sim", "object.urdf"), flags=pybullet.URDF_USE_INERTIA_FROM_FILE)
    shapes = len(pybullet.getCollisionShapeData(body, -1))
    print(f"  object.urdf: {shapes} collision shapes")
    if shapes != report["hulls"]:
        raise AssertionError(f"{shapes} collision shapes for {report['hulls']} hulls")
    close("mass", [pybullet.getDynamicsInfo(body, -1)[0]], [report["mass"]["mass_kg"]], 1e-5)
    for _ in range(1500):
        pybullet.stepSimulation()
    (x, y, z), _ = pybullet.getBasePositionAndOrientation(body)
    contacts = len(pybullet.getContactPoints(body))
    print(f"  after 6 s of falling: z {z:.3f} m, {contacts} contacts")
    if not (-0.3 < z < 0.3 and contacts > 0):
        raise AssertionError("the body doesn't come to rest on the plane")
    pybullet.disconnect()


def main():
    out = sys.argv[1]
    with open(os.path.join(out, "export.json")) as file:
        report = json.load(file)
    failed = False
    for name, load in (("trimesh", load_trimesh), ("mujoco", load_mujoco), ("pybullet", load_pybullet)):
        if load is not load_trimesh and not report["mass"]:
            print(f"{name}: skipped, there is no sim/ (export with --sim)")
            continue
        try:
            version = getattr(__import__(name), "__version__", "")
        except ImportError:
            print(f"{name}: skipped, it is not installed")
            continue
        print(f"{name} {version}")
        try:
            load(out, report)
        except Exception as error:  # any failure of a peer is a finding
            print(f"  FAILED: {error}")
            failed = True
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
