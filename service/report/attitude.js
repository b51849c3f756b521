// Attitude in 3-D on a canvas: the body of each run, the desired attitude as a ghost, and the inertial axes.
"use strict";

const scene = document.getElementById("attitude-3d");
const BODY = [[0.9, 0.3, 0.12], [0.9, -0.3, 0.12], [-0.9, -0.3, 0.12], [-0.9, 0.3, 0.12],
  [0.9, 0.3, -0.12], [0.9, -0.3, -0.12], [-0.9, -0.3, -0.12], [-0.9, 0.3, -0.12]]; // corners, x forward and z up
const FACES = [[0, 1, 2, 3], [7, 6, 5, 4], [0, 4, 5, 1], [1, 5, 6, 2], [2, 6, 7, 3], [3, 7, 4, 0]];
const NOSE = [[1.25, 0, 0], [0.9, 0.18, 0], [0.9, -0.18, 0]];
let view = { azimuth: -0.6, height: 0.45 }; // of the eye [rad]

/** A vector of the body frame in the inertial frame, by the unit quaternion (w, x, y, z). */
function turned([w, x, y, z], [a, b, c]) {
  const [tx, ty, tz] = [2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)];
  return [a + w * tx + y * tz - z * ty, b + w * ty + z * tx - x * tz, c + w * tz + x * ty - y * tx];
}

/** Where a point of the inertial frame is on the canvas, and how near it is to the eye. */
function projected([x, y, z], size) {
  const [sa, ca, sh, ch] = [Math.sin(view.azimuth), Math.cos(view.azimuth), Math.sin(view.height), Math.cos(view.height)];
  const [right, towards] = [ca * y - sa * x, ca * x + sa * y];
  return [size.x + size.scale * right, size.y - size.scale * (ch * z - sh * towards), ch * towards + sh * z];
}

/** The attitude of a run at a time, measured or desired: a unit quaternion; null where it is not known. */
function attitudeAt(run, quantity, time) {
  const at = lastAt(run, time);
  const parts = (drawings.attitude?.data ?? []).filter((line) => line.times === run && line.quantity === quantity);
  const q = parts.map((line) => line.y[at]);
  const length = Math.hypot(...q);
  return at >= 0 && q.length === 4 && length > 0.1 ? q.map((part) => part / length) : null;
}

/** Draw the scene at a time [s]. */
function showAttitude(time) {
  if (!scene || scene.clientWidth === 0) return;
  const ratio = devicePixelRatio || 1;
  const [width, height] = [scene.clientWidth, scene.clientHeight];
  if (scene.width !== Math.round(width * ratio)) [scene.width, scene.height] = [width * ratio, height * ratio].map(Math.round);
  const on = scene.getContext("2d");
  on.setTransform(ratio, 0, 0, ratio, 0, 0);
  on.clearRect(0, 0, width, height);
  const size = { x: width / 2, y: height / 2, scale: Math.min(width, height) / 3.1 };
  const path = (points, isClosed = true) => {
    on.beginPath();
    points.forEach((point, i) => on[i ? "lineTo" : "moveTo"](...projected(point, size)));
    if (isClosed) on.closePath();
  };
  on.font = "12px system-ui, sans-serif";
  [["x", [1.3, 0, 0]], ["y", [0, 1.3, 0]], ["z", [0, 0, 1.3]]].forEach(([name, axis]) => {
    on.strokeStyle = on.fillStyle = colour("quiet");
    path([[0, 0, 0], axis], false);
    on.stroke();
    const [x, y] = projected(axis.map((each) => each * 1.06), size);
    on.fillText(name, x - 3, y + 4);
  });
  const body = (q, stroke, isGhost) => {
    const corners = BODY.map((corner) => turned(q, corner));
    const nearness = (face) => face.reduce((sum, i) => sum + projected(corners[i], size)[2], 0);
    on.strokeStyle = on.fillStyle = stroke;
    on.setLineDash(isGhost ? [4, 3] : []);
    for (const face of [...FACES].sort((a, b) => nearness(a) - nearness(b))) {
      path(face.map((i) => corners[i]));
      on.globalAlpha = isGhost ? 0.06 : 0.3;
      on.fill();
      on.globalAlpha = isGhost ? 0.7 : 1;
      on.stroke();
    }
    path(NOSE.map((point) => turned(q, point)));
    on.fill();
    on.setLineDash([]);
    on.globalAlpha = 1;
  };
  runTimes.forEach((_, run) => {
    const [desired, measured] = ["desired", "measured"].map((quantity) => attitudeAt(run, quantity, time ?? span[0]));
    const strokes = (drawings.attitude?.data ?? []).filter((line) => line.times === run);
    const stroke = (quantity) => onPage(strokes.find((line) => line.quantity === quantity)?.line.color ?? "#888888");
    if (desired && run === 0) body(desired, stroke("desired"), true);
    if (measured) body(measured, stroke("measured"), false);
  });
}

scene?.addEventListener("pointermove", (event) => {
  if (!event.buttons) return;
  view = { azimuth: view.azimuth - event.movementX / 150, height: Math.min(1.5, Math.max(-1.5, view.height + event.movementY / 150)) };
  showAttitude(cursor);
});

begin();
