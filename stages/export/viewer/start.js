// The page: unpacks the embedded scene and puts everything together.
//
// For tests and for embedding, `window.dentalsplat` offers
//   ready                  a promise, fulfilled once the first picture has been drawn
// and from then on
//   views                  the poses of the photographs
//   state                  what the page shows (see link.js)
//   setCamera(m, fx, fy, cx, cy, width, height)
//                          exact camera: m = cam_from_world (12 or 16 numbers, row-major, OpenCV
//                          axes), and the canvas gets exactly that many pixels
//   setBackground([r, g, b])   in 0..1
//   pick(x, y)             the place of the surface under a pixel of the canvas, or null
//   render()               sort and draw now, not at the next frame
//   pixels()               the drawn picture, RGBA bytes, top row first
// In the address, `#view=3` opens at the third photograph, `&bare` hides the controls, `&still` turns
// moving transitions off; what else a link holds is in link.js. Errors are kept in
// <html data-errors>, progress in <html data-state>.

/** Follow the address. */
function readAddress(viewer, tools) {
  const { hash } = location;
  const wanted = new URLSearchParams(hash.slice(1));
  viewer.still = wanted.has("still");
  byId("bar").hidden = byId("label").hidden = wanted.has("bare");
  const { views, orbiting } = viewer.scene;
  const { state, camera, scene } = readLink(hash, orbiting, views.length);
  // a link with a camera is of the whole page: what it does not name is as at first
  const whole = camera ? { ...new Store().now, ...state } : state;
  if (Object.keys(whole).length) tools.show(tools.possible(whole));
  if (camera || state.marks || scene) tools.comesFrom(scene);
  if (hash.length > LONGEST_LINK) {
    tools.tell("The link is too long to be read: what it shows, marks and notes are not there.", 20);
  }
  if (camera) {
    viewer.stand(camera);
    return true;
  }
  const number = Number(wanted.get("view"));
  if (!Number.isInteger(number) || number < 1 || number > views.length) return false;
  viewer.goTo(number - 1, { still: root.dataset.state !== "ready" });
  return true;
}

function hookOf(viewer) {
  return {
    get state() { return viewer.store.now; },
    views: viewer.scene.views.map(({ photo, ...pose }) => pose),
    setCamera(matrix, fx, fy, cx, cy, width, height) {
      const row = (k) => matrix.slice(4 * k, 4 * k + 3);
      viewer.stopTurning();
      viewer.leave();
      viewer.exact = {
        rotation: [...row(0), ...row(1), ...row(2)], translation: [3, 7, 11].map((k) => matrix[k]),
        fx, fy, cx, cy, width, height,
      };
      viewer.wake();
    },
    setBackground(rgb) {
      viewer.backdrop = rgb;
      viewer.wake(false);
    },
    pick(x, y) {
      const [{ pose }] = viewer.panes();
      const fine = viewer.canvas.width / viewer.canvas.clientWidth;
      return pick(viewer.splats, viewer.scene, { pose, x, y, fine }, viewer.shownParts());
    },
    render: () => viewer.render(),
    pixels() {
      viewer.render();
      const { gl, canvas } = viewer.renderer;
      const row = 4 * canvas.width;
      const upward = new Uint8Array(row * canvas.height);
      gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, upward);
      const downward = new Uint8Array(upward.length);
      for (let y = 0; y < canvas.height; y++) {
        downward.set(upward.subarray(y * row, (y + 1) * row), (canvas.height - 1 - y) * row);
      }
      return downward;
    },
  };
}

async function start() {
  const scene = JSON.parse(byId("scene").textContent);
  const text = byId("splats").textContent;
  byId("splats").remove();  // a megabyte and more
  const splats = await unpacked(text, scene.format);
  const viewer = new Viewer(scene, splats, new Store());
  const tools = new Tools(viewer);
  viewer.marks = new Marks(viewer);
  addPanel(viewer, tools);
  addViewButtons(viewer);
  addButtons(viewer);
  addKeys(viewer, tools);
  addPointers(viewer, (x, y) => tools.placeAt(x, y));
  viewer.goTo(scene.first, { still: true });
  readAddress(viewer, tools);
  viewer.render();
  Object.defineProperties(
    window.dentalsplat, Object.getOwnPropertyDescriptors(hookOf(viewer)));
  root.dataset.state = "ready";

  addEventListener("resize", () => viewer.wake(false));
  addEventListener("hashchange", () => readAddress(viewer, tools));
  const restore = () => {
    viewer.renderer.restore();
    viewer.wake();
  };
  keepContext(viewer.canvas, restore, (gone) => {
    if (gone) {
      byId("reason").textContent = "The browser took the graphics card away from this page. Copy a link (L) "
        + "if you made marks, then load the page again; if that does not help, close other pages with 3D "
        + "scenes or start the browser anew.";
    }
    byId("message").hidden = !gone;
  });
}

window.dentalsplat = {};
window.dentalsplat.ready = start().catch(fail);
