"""What the files of an export are for."""

from __future__ import annotations

from msgs_slam.pipelines.types import Metres
from msgs_slam.pipelines.upright.world import World

_FILES = """\
What is in this folder

sparse/0/                 camera, poses and points as a COLMAP model, binary and text; pinhole, no distortion left. A
                          frame of which only the rotation is known is in trajectory.txt alone.
                          Opens in COLMAP, pycolmap, and any Gaussian splatting trainer.
frames/                   the undistorted frames that the model names.
masks/                    only where people or --masks leave something out: NAME.png for the frame NAME, black is left
                          out (colmap feature_extractor --ImageReader.mask_path masks).
transforms.json           the same cameras for nerfstudio.
trajectory.txt            poses in TUM format: timestamp tx ty tz qx qy qz qw (camera in the world); evo reads it.
point_cloud.ply           the map: Gaussians in the layout of the original 3D Gaussian splatting, with class_id and
                          class_prob_<class> of the classes that occur after it. Splat viewers (SuperSplat and
                          others) open it.
point_cloud_semantic.ply  the same, coloured by class, without the probabilities.
point_cloud_compact.safetensors   the same in a fraction of the space.
point_cloud.spz           only with --set export.spz=true: the colours of the map, small, for viewers on the web.
point_cloud.sog           only by `msgs-slam export RUN --only sog`: the same, smaller still (PlayCanvas, SuperSplat).
point_cloud.glb           only with --set export.splat_glb=true: the map in glTF (KHR_gaussian_splatting), classes as
                          attribute _LABEL; programs that do not know the extension show coloured points.
map.html                  only by `msgs-slam export RUN --only html`: the map to look at in any browser, without a
                          server or a network, on a computer or a phone.
mesh.ply, mesh.glb        the surface with a colour and a label (PLY: property label, GLB: attribute _LABEL) at each
                          vertex. MeshLab, Blender, trimesh.
mesh_textured.obj, .mtl, .png, mesh_textured.glb   only with --set export.texture=true: a tenth of the mesh's vertices,
                          and its surface as a picture made from the keyframes' photographs, exposure removed. OBJ: a
                          group for each class.
classes.json              number, name and colour of each class; 255 is "unknown".
scale.json                how many metres a unit of the run is, its relative standard deviation, and who says so.
submap_1/ and so on       only where the map was made in parts (mapping.submap): point_cloud.ply of each part, and
                          coarse.ply, about a tenth of it for a look from afar; tiles.json says where each lies.
piece_2/ and so on        only where nothing joins some frames to the rest: the same of them, in a world of their own.
world.json                what the axes are, what told which way is up, and how this world lies to the run's own.

"""

_UPRIGHT = """\
Axes: z is up, told by the {told_by}; {height}.
{heading}. The formats that lay down which way is up follow their own
rule: in all GLB files and in point_cloud.spz y is up. A viewer that takes y for up shows the PLY files on their
back: turn them by -90 degrees about x.
"""

_OWN_HEADING = """\
x and y count from the middle of the camera's path, and y points where the first camera looked"""

_FIRST = """\
Axes: the run's own, about those of the first posed camera: x right, y down, z forward{why}.
"""

_FREE = "The unit of lengths is free: one camera cannot tell metres. Metric depth or --scale-ref makes them metres."


def lengths(metres: Metres | None, metric: bool) -> str:
    """What one unit of length is, in a line or two of plain text."""
    if metres is None:
        return "Lengths are metres." if metric else _FREE
    if metric:
        return f"Lengths are metres: {metres.text}."
    return (
        f"{metres.text[0].upper()}{metres.text[1:]}.\n"
        f"Coordinates are not rescaled: multiply lengths by {metres.per_unit:.3g} to have them in metres."
    )


def readme(world: World, metres: Metres | None, metric: bool) -> str:
    """The text of README.txt for files in that world."""
    if world.axes == "up":
        height = "the floor is at z = 0" if world.has_floor else "no floor was found, so z counts from that path too"
        heading = "x is east and y north (GPS, see world.json)" if world.earth else _OWN_HEADING
        axes = _UPRIGHT.format(told_by=world.told_by, height=height, heading=heading)
    else:
        axes = _FIRST.format(why=", since nothing told which way is up or nobody asked (export.axes)")
    return _FILES + axes + lengths(metres, metric) + "\n"
