"""Files that hold a scene: transforms of nodes, units and instances of GLB and USD."""

import numpy as np
import pytest
import trimesh
from scipy import sparse

from spadwarp.mesh import describe_mesh, load_target
from spadwarp.scene import Target
from spadwarp.values import MeshError


def loaded(path):
    return load_target(Target(mesh=str(path)))


def bounds_of_bodies(mesh):
    """Lower and upper corner of each connected body, sorted."""
    mesh.merge_vertices()
    graph = sparse.coo_matrix((np.ones(len(mesh.edges)), mesh.edges.T), shape=[len(mesh.vertices)] * 2)
    bodies = sparse.csgraph.connected_components(graph, directed=False)[1]
    groups = [mesh.vertices[bodies == body] for body in np.unique(bodies)]
    found = [np.array([points.min(axis=0), points.max(axis=0)]) for points in groups]
    return np.array(sorted(found, key=lambda bounds: tuple(np.round(bounds.ravel(), 6))))


def test_nodes_and_instances_of_a_glb(tmp_path):
    """One box at two nodes, one of them turned and stretched below a parent that is moved."""
    box = trimesh.creation.box(extents=(1.0, 2.0, 0.5))
    turned = trimesh.transformations.rotation_matrix(np.pi / 2, [0, 0, 1]) @ np.diag([2.0, 1.0, 1.0, 1.0])
    scene = trimesh.Scene()
    scene.add_geometry(box, node_name="one", geom_name="box")
    moved = trimesh.transformations.translation_matrix([10.0, 0.0, 3.0])
    scene.graph.update(frame_to="parent", matrix=moved)
    scene.graph.update(frame_to="two", frame_from="parent", matrix=turned, geometry="box")
    scene.export(tmp_path / "scene.glb")
    expected = [[[-0.5, -1.0, -0.25], [0.5, 1.0, 0.25]], [[9.0, -1.0, 2.75], [11.0, 1.0, 3.25]]]
    np.testing.assert_allclose(bounds_of_bodies(loaded(tmp_path / "scene.glb")), expected, atol=1e-5)


try:
    from pxr import Gf, Usd, UsdGeom
except ImportError:
    Usd = None


@pytest.fixture
def stage(tmp_path):
    if Usd is None:
        pytest.skip("usd-core is not installed")
    made = Usd.Stage.CreateNew(str(tmp_path / "scene.usda"))
    UsdGeom.SetStageMetersPerUnit(made, 0.01)
    return made


def polygon_box(stage, path):
    """A cube of side 2 of four-cornered faces."""
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    mesh.CreateFaceVertexCountsAttr([4] * 6)
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    mesh.CreateFaceVertexIndicesAttr([index for face in faces for index in face])
    return mesh


def saved(stage):
    stage.Save()
    return stage.GetRootLayer().realPath


def test_units_transforms_and_polygons_of_usd(stage):
    outer = UsdGeom.Xform.Define(stage, "/outer")
    outer.AddTranslateOp().Set((100, 0, 0)), outer.AddRotateZOp().Set(90)
    inner = polygon_box(stage, "/outer/box")
    inner.AddScaleOp().Set((30, 10, 5))
    mesh = loaded(saved(stage))
    np.testing.assert_allclose(mesh.bounds, [[0.9, -0.3, -0.05], [1.1, 0.3, 0.05]], atol=1e-6)
    assert mesh.volume == pytest.approx(0.2 * 0.6 * 0.1, rel=1e-5) and len(mesh.faces) == 12


def test_instances_of_usd(stage):
    polygon_box(stage, "/shelf/box")
    UsdGeom.Imageable(stage.GetPrimAtPath("/shelf")).MakeInvisible()
    for number in range(2):
        copy = UsdGeom.Xform.Define(stage, f"/copy{number}")
        copy.GetPrim().GetReferences().AddInternalReference("/shelf")
        copy.GetPrim().SetInstanceable(True)
        UsdGeom.Imageable(copy).CreateVisibilityAttr("inherited")
        copy.AddTranslateOp().Set((1000.0 * number, 0, 0))
    instancer = UsdGeom.PointInstancer.Define(stage, "/many")
    instancer.AddTranslateOp().Set((0, 5000, 0))
    cube = UsdGeom.Cube.Define(stage, "/many/cube")
    cube.CreateSizeAttr(20.0)
    instancer.CreatePrototypesRel().AddTarget(cube.GetPath())
    instancer.CreateProtoIndicesAttr([0, 0, 0])
    instancer.CreatePositionsAttr([(0, 0, 0), (0, 0, 100), (0, 0, 200)])
    instancer.CreateScalesAttr([(1, 1, 1), (2, 1, 1), (1, 1, 1)])
    instancer.CreateOrientationsAttr([Gf.Quath(1, 0, 0, 0)] * 3)
    bodies = bounds_of_bodies(loaded(saved(stage)))
    centres, sides = bodies.mean(axis=1), np.ptp(bodies, axis=1)
    order = np.lexsort(centres.T)
    expected = [[0, 0, 0], [10, 0, 0], [0, 50, 0], [0, 50, 1], [0, 50, 2]]
    np.testing.assert_allclose(centres[order], expected, atol=1e-6)
    np.testing.assert_allclose(sides[order], [[0.02] * 3] * 2 + [[0.2] * 3, [0.4, 0.2, 0.2], [0.2] * 3], atol=1e-6)


def test_simple_shapes_of_usd(stage):
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    cylinder = UsdGeom.Cylinder.Define(stage, "/cylinder")
    cylinder.CreateAxisAttr("Y"), cylinder.CreateHeightAttr(4.0), cylinder.CreateRadiusAttr(0.5)
    UsdGeom.Sphere.Define(stage, "/guide").CreatePurposeAttr("guide")
    mesh = loaded(saved(stage))
    np.testing.assert_allclose(np.ptp(mesh.bounds, axis=0), [1.0, 4.0, 1.0], atol=1e-3)
    assert mesh.volume == pytest.approx(np.pi, rel=5e-3)


def test_what_is_no_usd_scene_is_named(stage, tmp_path):
    with pytest.raises(MeshError, match="holds no visible mesh"):
        loaded(saved(stage))
    (tmp_path / "text.usda").write_text("no stage")
    with pytest.raises(MeshError, match=r"text\.usda.*not a readable USD stage"):
        loaded(tmp_path / "text.usda")
    polygon_box(stage, "/box")
    assert describe_mesh(saved(stage)).extent == pytest.approx((0.02, 0.02, 0.02))
