"""Open a scene that ``nerg export scene`` has written as USD in Blender, and colour its meshes and points by attention.

    nerg export scene scene.xml day.npz day.ply -o shop.usdc
    blender --python examples/blender_scene.py -- shop.usdc
    blender --background --python examples/blender_scene.py -- shop.usdc --render shop.png

It also runs without Blender's interface where the package ``bpy`` is installed: python examples/blender_scene.py
shop.usdc --render shop.png. The script needs Blender 4.2 or newer and nothing of nerg_mi.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import bpy  # pyright: ignore[reportMissingImports]

ATTENTION, COLOR = "attention", "displayColor"
# Colours of the map "inferno" at equal steps, linear.
INFERNO = ((0.0, 0.0, 0.001), (0.093, 0.003, 0.156), (0.496, 0.038, 0.091), (0.946, 0.263, 0.004), (0.972, 1.0, 0.371))


def attention_material(top: float) -> bpy.types.Material:
    """A material that shows the attribute `ATTENTION` from 0 to ``top`` over grey."""
    material = bpy.data.materials.new(ATTENTION)
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    attribute, scale, ramp = (nodes.new(f"ShaderNode{kind}") for kind in ("Attribute", "Math", "ValToRGB"))
    attribute.attribute_name = ATTENTION
    scale.operation, scale.use_clamp, scale.inputs[1].default_value = "DIVIDE", True, top
    for k, color in enumerate(INFERNO):
        at = k / (len(INFERNO) - 1)
        element = ramp.color_ramp.elements[k] if k == 0 else ramp.color_ramp.elements.new(at)
        element.position, element.color = at, (*(color if k else (0.2, 0.2, 0.2)), 1.0)
    ramp.color_ramp.elements.remove(ramp.color_ramp.elements[-1])
    shader, output = nodes.new("ShaderNodeEmission"), nodes.new("ShaderNodeOutputMaterial")
    links.new(attribute.outputs["Fac"], scale.inputs[0])
    links.new(scale.outputs["Value"], ramp.inputs["Fac"])
    links.new(ramp.outputs["Color"], shader.inputs["Color"])
    links.new(shader.outputs["Emission"], output.inputs["Surface"])
    return material


def surface_material(is_colored: bool) -> bpy.types.Material:
    """A material for what has no attention: its colours or grey, lit by a headlight as in nerg_mi's own pictures."""
    material = bpy.data.materials.new("surface")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    geometry, facing = nodes.new("ShaderNodeNewGeometry"), nodes.new("ShaderNodeVectorMath")
    size, light = nodes.new("ShaderNodeMath"), nodes.new("ShaderNodeMath")
    facing.operation, size.operation, light.operation = "DOT_PRODUCT", "ABSOLUTE", "MULTIPLY_ADD"
    light.inputs[1].default_value, light.inputs[2].default_value = 0.7, 0.3
    shader, output = nodes.new("ShaderNodeEmission"), nodes.new("ShaderNodeOutputMaterial")
    links.new(geometry.outputs["Normal"], facing.inputs[0])
    links.new(geometry.outputs["Incoming"], facing.inputs[1])
    links.new(facing.outputs["Value"], size.inputs[0])
    links.new(size.outputs["Value"], light.inputs[0])
    links.new(light.outputs["Value"], shader.inputs["Strength"])
    links.new(shader.outputs["Emission"], output.inputs["Surface"])
    if is_colored:
        color = nodes.new("ShaderNodeAttribute")
        color.attribute_name = COLOR
        links.new(color.outputs["Color"], shader.inputs["Color"])
    else:
        shader.inputs["Color"].default_value = (0.5, 0.5, 0.5, 1.0)
    return material


def quantile(values: list[float], share: float) -> float:
    """The value that ``share`` of ``values`` do not exceed."""
    return sorted(values)[min(int(share * len(values)), len(values) - 1)]


def open_scene(path: Path) -> dict[str, int]:
    """Import the USD file ``path`` into an empty file, and return the number of objects of each type."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.usd_import(filepath=str(path.resolve()), import_all_materials=True)
    counts: dict[str, int] = {}
    for thing in bpy.data.objects:
        counts[thing.type] = counts.get(thing.type, 0) + 1
        if thing.type not in ("MESH", "POINTCLOUD"):
            continue
        thing.data.materials.clear()
        values = thing.data.attributes.get(ATTENTION)
        if values is None:
            thing.data.materials.append(surface_material(COLOR in thing.data.attributes))
        else:
            top = quantile([v.value for v in values.data], 0.995)
            thing.data.materials.append(attention_material(top or 1.0))
    cameras = [thing for thing in bpy.data.objects if thing.type == "CAMERA"]
    bpy.context.scene.camera = cameras[0] if cameras else None
    return counts


def render(path: Path, width: int, height: int) -> None:
    """Render the first camera with Cycles on the processor."""
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.samples = "CYCLES", 32
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = width, height, 100
    scene.view_settings.view_transform = "Standard"
    scene.render.filepath = str(path.resolve())
    bpy.ops.render.render(write_still=True)


def main() -> None:
    """Read the arguments after ``--``, or all of them outside of Blender."""
    words = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path, help="USD file of nerg export scene")
    parser.add_argument("--render", type=Path, default=None, help="image to render from the first camera")
    parser.add_argument("--width", type=int, default=720)
    parser.add_argument("--height", type=int, default=480)
    args = parser.parse_args(words)
    print(open_scene(args.scene))
    if args.render is not None:
        render(args.render, args.width, args.height)


if __name__ == "__main__":
    main()
