"""A tile set drawn by CesiumJS in headless Chromium: a screenshot to look at, and what was loaded.

npm pack cesium @cesium/engine; tar xzf cesium-*.tgz
python tests/benchmarks/tileset.py RUN/export/tiles package out.png [--tilt -25] [--away 1.2]
"""

import argparse
import functools
import http.server
import json
import shutil
import sys
import tempfile
import threading
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.browser import browser

PAGE = """<!doctype html><meta charset="utf-8">
<link rel="stylesheet" href="/cesium/Widgets/widgets.css">
<style>html, body, #scene { margin: 0; width: 100%; height: 100%; } .cesium-widget-credits { display: none; }</style>
<script>window.CESIUM_BASE_URL = "/cesium/"; window.told = { errors: [], tiles: {} };</script>
<script src="/cesium/Cesium.js"></script>
<div id="scene"></div>
<script>
(async () => {
  const { Cartesian3, Math: { toRadians }, Matrix4, Transforms } = Cesium;
  const bare = { baseLayer: false, skyBox: false, globe: false, skyAtmosphere: false };
  const scene = new Cesium.CesiumWidget("scene", bare).scene;
  const tiles = await Cesium.Cesium3DTileset.fromUrl("/tiles/tileset.json", { maximumScreenSpaceError: 2 });
  tiles.tileFailed.addEventListener((e) => told.errors.push(`${e.url}: ${e.message}`));
  tiles.tileVisible.addEventListener(({ content }) => { told.tiles[content.url] = content.pointsLength; });
  tiles.allTilesLoaded.addEventListener(() => { told.loaded = true; });
  scene.primitives.add(tiles);
  const { center, radius } = tiles.boundingSphere, onEarth = Cartesian3.magnitude(center) > 1e6;
  const frame = onEarth ? Transforms.eastNorthUpToFixedFrame(center) : Matrix4.fromTranslation(center);
  scene.camera.lookAtTransform(
    frame, new Cesium.HeadingPitchRange(toRadians(HEADING), toRadians(TILT), AWAY * radius));
})().catch((error) => told.errors.push(String(error.stack)));
</script>"""


class Served(http.server.SimpleHTTPRequestHandler):
    """A folder, without a line for each file."""

    def log_message(self, *_: object) -> None:
        """Nothing."""


def main() -> None:
    """Serve, look, print what CesiumJS says it loaded."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tiles", type=Path)
    parser.add_argument("cesium", type=Path, help="folder of the unpacked npm package")
    parser.add_argument("picture", type=Path)
    parser.add_argument("--heading", type=float, default=0.0)
    parser.add_argument("--tilt", type=float, default=-25.0)
    parser.add_argument("--away", type=float, default=1.2)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        page = PAGE.replace("HEADING", str(given.heading)).replace("TILT", str(given.tilt))
        page = page.replace("AWAY", str(given.away))
        (root / "index.html").write_text(page, encoding="utf-8")
        shutil.copytree(given.tiles, root / "tiles")
        (root / "cesium").symlink_to((given.cesium / "Build" / "Cesium").resolve())
        server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Served, directory=name))
        threading.Thread(target=server.serve_forever, daemon=True).start()
        with browser(root / "profile", (1280, 800)) as tab:
            tab.call("Page.navigate", url=f"http://127.0.0.1:{server.server_port}/index.html")
            end = time.monotonic() + 150
            while time.monotonic() < end:
                told = json.loads(tab.value("JSON.stringify(window.told || {})"))
                if told.get("loaded") or told.get("errors"):
                    break
                time.sleep(1)
            time.sleep(15)  # the sorted splats come a few frames later
            tab.screenshot(given.picture)
            print(tab.value("JSON.stringify(window.told, null, 1)"))
        server.shutdown()


if __name__ == "__main__":
    main()
