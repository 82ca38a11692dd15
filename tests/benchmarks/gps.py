"""How a finished run of photos with GPS lies on the Earth, beside pycolmap, with and without a fix that is 500 m off.

    python tests/benchmarks/gps.py RUN              the run's export, and pose priors in an adjustment of its model
    python tests/benchmarks/gps.py RUN --colmap     and pycolmap's own model of the same pictures, aligned by pycolmap

Every row: root mean square of the horizontal distance to the fixes, of a coordinate, of those that belong (all but the
wrong one), and how far the cameras moved from where the run's export has them.
"""

import argparse
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
import pycolmap
from numpy.typing import NDArray

from msgs_slam.formats.gps import enu_from_geodetic, photo_places
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import load_outcome
from msgs_slam.pipelines.scene.gps import georeference
from msgs_slam.pipelines.scene.world import WORLD
from msgs_slam.pipelines.source.recording import FolderRecording, open_recording

Array = NDArray[np.float64]
WRONG, OFF = 12, np.array([500.0, 0, 0])
LEAST = 5
RANSAC_METRES = 15.0
"""EXIF's own accuracy is about 10 m."""


def ransac() -> pycolmap.RANSACOptions:
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = RANSAC_METRES, 0
    return options


def centers(model: pycolmap.Reconstruction, names: list[str]) -> Array:
    by_name = {image.name: image for image in model.images.values() if image.has_pose}
    return np.array([by_name[n].projection_center() if n in by_name else np.full(3, np.nan) for n in names])


def tell(what: str, placed: Array, fixes: Array, ours: Array, right: NDArray[np.bool_]) -> None:
    known = right & np.isfinite(placed).all(1)
    rms = np.sqrt(((placed - fixes)[known, :2] ** 2).mean())
    moved = np.sqrt(((placed - ours)[known, :2] ** 2).sum(1).mean())
    print(f"  {what}: {rms:.2f} m a coordinate, {known.sum()} pictures, {moved:.2f} m from the export", flush=True)


def with_priors(model: pycolmap.Reconstruction, names: list[str], fixes: Array, sd: float) -> pycolmap.Reconstruction:
    """The model aligned and adjusted with a prior at each fix: `sd` metres level, three times that in height."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary, options.refine_extra_params = False, False
    options.ceres.loss_function_type, options.ceres.use_gpu = pycolmap.LossFunctionType.CAUCHY, False
    prior_options = pycolmap.PosePriorBundleAdjustmentOptions()
    prior_options.alignment_ransac = ransac()
    prior_options.ceres.prior_position_loss_function_type = pycolmap.LossFunctionType.CAUCHY
    config, priors = pycolmap.BundleAdjustmentConfig(), []
    by_name = {image.name: image for image in model.images.values()}
    for name, fix in zip(names, fixes, strict=True):
        config.add_image(by_name[name].image_id)
        prior = pycolmap.PosePrior(position=fix, position_covariance=np.diag([sd**2, sd**2, 9 * sd**2]))
        prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
        prior.corr_data_id = by_name[name].data_id
        priors.append(prior)
    pycolmap.create_pose_prior_bundle_adjuster(options, prior_options, config, priors, model).solve()
    return model


def own_models(folder: Path, names: list[str], work: Path) -> dict[str, pycolmap.Reconstruction | None]:
    """The largest model of pycolmap's incremental mapper with all its defaults, and with less asked of the first pair
    and of a picture that is added; every picture is matched with every other."""
    database = work / "database.db"
    pycolmap.extract_features(database, folder, names, pycolmap.CameraMode.SINGLE)
    pycolmap.match_exhaustive(database)
    made = {}
    relaxed = pycolmap.IncrementalPipelineOptions()
    relaxed.min_model_size, relaxed.random_seed = 3, 0
    relaxed.mapper.init_min_num_inliers, relaxed.mapper.init_min_tri_angle = 30, 4.0
    relaxed.mapper.abs_pose_min_num_inliers = 15
    for name, options in (("default", pycolmap.IncrementalPipelineOptions()), ("relaxed", relaxed)):
        (work / name).mkdir()
        models = pycolmap.incremental_mapping(database, folder, work / name, options)
        made[name] = max(models.values(), key=lambda m: m.num_reg_images(), default=None)
    return made


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--colmap", action="store_true")
    arguments = parser.parse_args()
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    run = RunFolder(arguments.run)
    outcome, world = load_outcome(run), run.find(WORLD)
    if world is None or world.earth is None:
        sys.exit(f"{run.root}: its export has no place on the Earth")
    source = open_recording(Path(run.source.path), outcome.config.run.format)
    assert isinstance(source, FolderRecording)
    posed = outcome.trajectory.is_posed
    frames = [f for f, has in zip(outcome.frames, posed, strict=True) if has]
    names = [f.name for f in frames]
    places = photo_places([source.file(f.source_index) for f in frames])
    fixes = enu_from_geodetic(places, np.array(world.earth.origin))
    ours = world.exported_from_run.apply(outcome.trajectory.centers[posed])
    span = np.ptp(fixes[:, :2], axis=0)
    print(f"{run.root}: {len(names)} of {len(outcome.frames)} posed; {span[0]:.0f} x {span[1]:.0f} m; {world.earth}")
    for wrong in (False, True):
        given, right = fixes.copy(), np.ones(len(names), bool)
        if wrong:
            given[WRONG] += OFF
            right[WRONG] = False
        print("one fix 500 m off:" if wrong else "as they are:")
        geodetic = places.copy()
        geodetic[WRONG, 1] += wrong * OFF[0] / (111_320 * np.cos(np.radians(places[WRONG, 0])))
        found = georeference(ours, geodetic, outcome.metric)
        assert not isinstance(found, str)
        shift = enu_from_geodetic(np.array([found[1].origin]), np.array(world.earth.origin))[0]
        tell("ours", found[0].apply(ours) + shift, fixes, ours, right)
        model = pycolmap.Reconstruction(str(run.file("export", "sparse/0/cameras.bin").parent))
        model.transform(pycolmap.align_reconstruction_to_locations(model, names, given, 3, ransac()))
        tell("our poses, pycolmap's alignment", centers(model, names), fixes, ours, right)
        for sd in (10.0, 2.0):
            tell(
                f"the same with priors of {sd:g} m",
                centers(with_priors(model, names, given, sd), names),
                fixes,
                ours,
                right,
            )
    if arguments.colmap:
        with tempfile.TemporaryDirectory() as work:
            for name, own in own_models(source.path, names, Path(work)).items():
                what = f"pycolmap's own {name} model"
                if own is None or own.num_reg_images() < LEAST:
                    print(f"  {what}: {0 if own is None else own.num_reg_images()} pictures, too few to align")
                    continue
                move = pycolmap.align_reconstruction_to_locations(own, names, fixes, 3, ransac())
                if move is None:
                    print(f"  {what}: {own.num_reg_images()} pictures, no three agree with their fixes")
                    continue
                own.transform(move)
                tell(what, centers(own, names), fixes, ours, np.ones(len(names), bool))


if __name__ == "__main__":
    main()
