"""Tests of `nerg_mi.transport.mitsuba_mesh`: with the installed Mitsuba, and with a double of the one after 3.9."""

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from nerg_mi.transport import mitsuba_mesh
from nerg_mi.transport.mitsuba_mesh import (
    add_attribute,
    count_faces,
    gather_corners,
    is_mesh,
    make_mesh,
    pack_positions,
    positions_key,
    read_attribute,
    read_triangles,
    unpack_positions,
    write_ply,
)

QUAD = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0.5), (-1, 1, 0)], float)
FACES = np.array([(0, 1, 2), (0, 2, 3)])
COLORS = np.random.default_rng(0).random((4, 3))


class MeshFromArrays:
    """Double of ``mi.Mesh`` of Mitsuba 3.10: the same checks and defaults, on a mesh of 3.9.

    The names of 3.9 are missing. Smooth normals are computed without ``face_normals``; normals must have unit length.
    """

    def __init__(self, props):
        self.props, self.has_flat_faces, self.mesh, self.attributes = props, props.get("face_normals", False), None, {}

    def from_fields(self, faces, positions, normals=None, texcoords=None):
        assert self.mesh is None, "was already built"
        count = positions.shape[0]
        for tensor, kind, shape in (
            (faces, mi.TensorXu, (faces.shape[0], 3)),
            (positions, mi.TensorXf, (count, 3)),
            (normals, mi.TensorXf, (count, 3)),
            (texcoords, mi.TensorXf, (count, 2)),
        ):
            assert tensor is None or (isinstance(tensor, kind) and tensor.shape == shape)
        sized = (self.props.id(), count, faces.shape[0], self.props)
        self.mesh = mi.Mesh(*sized, not self.has_flat_faces, texcoords is not None)  # noqa: TID251
        params = mi.traverse(self.mesh)
        params["vertex_positions"], params["faces"] = positions.array, faces.array
        if normals is not None and not self.has_flat_faces:
            assert np.allclose(np.linalg.norm(normals.numpy(), axis=1), 1, atol=1e-6)
            params["vertex_normals"] = normals.array
        if texcoords is not None:
            params["vertex_texcoords"] = texcoords.array
        params.update()
        if normals is None and not self.has_flat_faces:
            self.mesh.recompute_vertex_normals()

    def add_attribute(self, name, values):
        rows = self.mesh.vertex_count() if name.startswith("vertex_") else self.mesh.face_count()
        assert isinstance(values, mi.TensorXf) and values.shape[0] == rows
        self.attributes[name] = values
        self.mesh.add_attribute(name, values.shape[1], values.numpy().ravel())

    def parameters(self):
        positions = mi.TensorXf(mi.traverse(self.mesh)["vertex_positions"], (self.mesh.vertex_count(), 3))
        return {"positions": positions, **self.attributes}

    # The same in both versions.
    vertex_count = property(lambda self: self.mesh.vertex_count)
    face_count = property(lambda self: self.mesh.face_count)
    vertex_position = property(lambda self: self.mesh.vertex_position)
    face_indices = property(lambda self: self.mesh.face_indices)
    write_ply = property(lambda self: self.mesh.write_ply)


@pytest.fixture
def later(rgb, monkeypatch):
    """Make the module see Mitsuba 3.10, whose meshes are doubles."""
    if hasattr(rgb.Mesh, "from_fields"):
        pytest.skip("the double needs the meshes of Mitsuba 3.9, and the installed one is later")
    double = SimpleNamespace(
        Mesh=MeshFromArrays, traverse=lambda mesh: mesh.parameters(), Properties=rgb.Properties, load_dict=rgb.load_dict
    )
    for name in ("Float", "UInt32", "Point3f", "TensorXf", "TensorXu"):
        setattr(double, name, getattr(rgb, name))
    monkeypatch.setattr(mitsuba_mesh, "variant_types", lambda: double)


@pytest.fixture(params=["installed", "later"])
def version(request, rgb):
    if request.param == "later":
        request.getfixturevalue("later")
    return request.param


def picture(rgb, mesh):
    """Picture of the shading of a mesh, whose colours are its attribute."""
    return np.array(
        rgb.render(
            rgb.load_dict(
                {
                    "type": "scene",
                    "integrator": {"type": "aov", "aovs": "a:albedo,n:sh_normal,uv:uv"},
                    "sensor": {
                        "type": "perspective",
                        "to_world": rgb.ScalarTransform4f().look_at([0.3, 0.2, 3], [0, 0, 0], [0, 1, 0]),
                        "film": {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}},
                    },
                    "mesh": getattr(mesh, "mesh", mesh),
                }
            ),
            spp=4,
        )
    )


BSDF = {
    "type": "twosided",
    "bsdf": {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}},
}


def test_content_is_read_back(rgb, version, tmp_path):
    mesh = make_mesh(QUAD, FACES, "quad", bsdf=BSDF)
    assert type(mesh) is (MeshFromArrays if version == "later" else rgb.Mesh)
    assert is_mesh(mesh) and not is_mesh(rgb.load_dict({"type": "sphere"})) and not is_mesh(3)
    vertices, faces = read_triangles(mesh)
    assert np.array_equal(vertices, QUAD) and np.array_equal(faces, FACES) and count_faces(mesh) == 2
    assert (vertices.dtype, faces.dtype) == (np.float64, np.int64)
    assert read_attribute(mesh, "vertex_color") is None
    add_attribute(mesh, "vertex_color", COLORS)
    assert np.allclose(read_attribute(mesh, "vertex_color"), COLORS)
    write_ply(mesh, tmp_path / "quad.ply")
    assert rgb.load_dict({"type": "ply", "filename": str(tmp_path / "quad.ply")}).face_count() == 2


@pytest.mark.parametrize("normals", [None, [(0, 0, 1), (0, 0.6, 0.8), (0.6, 0, 0.8), (0, 0.28, 0.96)]])
def test_both_interfaces_make_the_same_mesh(rgb, request, normals):
    """Flat or smooth normals, texture coordinates, colours, name and material."""
    normals, pictures = None if normals is None else np.array(normals), []
    for version in ("installed", "later"):
        if version == "later":
            request.getfixturevalue("later")
            # Mitsuba 3.10 needs unit normals, and mesh files have others.
            normals = None if normals is None else 1.7 * normals
        mesh = make_mesh(QUAD, FACES, "quad", normals, (QUAD[:, :2] + 1) / 2, bsdf=BSDF)
        add_attribute(mesh, "vertex_color", COLORS)
        assert getattr(mesh, "mesh", mesh).id() == "quad"
        pictures.append(picture(rgb, mesh))
    assert np.allclose(*pictures, atol=1e-6) and np.ptp(pictures[0], axis=(0, 1))[[0, 3, 6]].min() > 0.1


def test_face_colors(rgb, version):
    mesh = make_mesh(QUAD, FACES, "quad")
    add_attribute(mesh, "face_color", COLORS[:2])
    assert np.allclose(read_attribute(mesh, "face_color"), COLORS[:2])


def test_opacities_of_colors_are_left_out(rgb, version):
    mesh = make_mesh(QUAD, FACES, "quad")
    for name, colors in (("vertex_color", COLORS), ("face_color", COLORS[:2])):
        add_attribute(mesh, name, np.column_stack([colors, np.full(len(colors), 0.5)]))
        assert np.allclose(read_attribute(mesh, name), colors)


def test_rectangles_have_triangles_and_follow_their_transform(rgb):
    """Their parameters do not include their vertices."""
    placed = rgb.ScalarTransform4f().translate([1, 2, 3]).scale([2, 1, 1])
    vertices, faces = read_triangles(rgb.load_dict({"type": "rectangle", "to_world": placed}))
    assert np.allclose(sorted(map(tuple, vertices)), [(-1, 1, 3), (-1, 3, 3), (3, 1, 3), (3, 3, 3)])
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    assert np.allclose(np.cross(b - a, c - a).sum(axis=0), [0, 0, 16])
    shape = rgb.load_dict({"type": "rectangle"})
    params, z = rgb.traverse(shape), rgb.Float(0)
    dr.enable_grad(z)
    params["to_world"] = rgb.Transform4f().translate(rgb.Vector3f(0, 0, z))
    params.update()
    corners = gather_corners(shape, rgb.UInt32([0, 1]))
    dr.forward(z)
    assert all(np.allclose(dr.grad(corner).numpy(), [[0], [0], [1]]) for corner in corners)
    assert count_faces(rgb.load_dict({"type": "cube"})) == 12


def test_positions_are_a_parameter(rgb, version):
    mesh = make_mesh(QUAD, FACES, "quad")
    value = mitsuba_mesh.variant_types().traverse(mesh)[positions_key()]
    points = unpack_positions(value)
    assert np.allclose(np.array(points).T, QUAD)
    assert type(pack_positions(points)) is type(value) and np.array_equal(pack_positions(points), value)
