"""What the files of an export are for."""

README = """\
What is in this folder

sparse/0/                 camera, poses and points as a COLMAP model, binary and text; pinhole, no distortion left.
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
mesh.ply, mesh.glb        the surface with a colour and a label (PLY: property label, GLB: attribute _LABEL) at each
                          vertex. MeshLab, Blender, trimesh.
classes.json              number, name and colour of each class; 255 is "unknown".

Axes: the world is the first keyframe: x right, y down, z forward. Lengths are metres where the proxy depth
is metric or a reference was given (--scale-ref); otherwise their unit is free, and `msgs-slam status` says so.
"""
