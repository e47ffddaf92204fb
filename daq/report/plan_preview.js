// Draws a plan: the arm as thick lines in 3-D, and curves over time with a cursor. Data: see plan_preview.py.
"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const arm = document.getElementById("arm"), slider = document.getElementById("time");
const play = document.getElementById("play"), swept = document.getElementById("swept"), words = document.getElementById("now");
const colours = data.colours, last = data.time_s.length - 1;
let yaw = 0.8, pitch = 0.45, zoom = 1.4, running = false, at = 0, before = 0;
slider.max = last;

function ink(name) { return getComputedStyle(document.documentElement).getPropertyValue(name).trim(); }

function sized(canvas) {
  const ratio = window.devicePixelRatio || 1, box = canvas.getBoundingClientRect();
  canvas.width = Math.round(box.width * ratio);
  canvas.height = Math.round(box.height * ratio);
  const pen = canvas.getContext("2d");
  pen.scale(ratio, ratio);
  pen.lineCap = "round";
  pen.lineJoin = "round";
  return [pen, box.width, box.height];
}

// Orthographic: x and y on the screen, and the scale of a metre.
function camera(width, height) {
  const scale = zoom * 0.46 * Math.min(width, height) / data.radius_m;
  const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
  const see = point => {
    const [x, y, z] = point.map((value, k) => value - data.centre_m[k]);
    return [width / 2 + scale * (cy * x + sy * y), height / 2 - scale * (cp * z - sp * (cy * y - sy * x))];
  };
  return [see, scale];
}

function line(pen, see, points, colour, thick, alpha) {
  pen.strokeStyle = colour;
  pen.globalAlpha = alpha;
  pen.lineWidth = Math.max(thick, 0.7);
  pen.beginPath();
  points.forEach((point, k) => (k ? pen.lineTo(...see(point)) : pen.moveTo(...see(point))));
  pen.stroke();
  pen.globalAlpha = 1;
}

function box(pen, see, lower, upper, colour) {
  const corner = bits => [0, 1, 2].map(k => (bits >> k & 1 ? upper[k] : lower[k]));
  for (let a = 0; a < 8; a++) for (const k of [1, 2, 4]) if (!(a & k)) line(pen, see, [corner(a), corner(a | k)], colour, 1, 0.7);
}

function posture(pen, see, scale, frame, alpha, thin) {
  data.capsules.forEach((capsule, k) => {
    const colour = colours[(capsule.link + 1) % colours.length];
    line(pen, see, data.ends_m[frame][k], colour, thin ? 1 : 2 * capsule.radius_m * scale, alpha);
  });
  line(pen, see, data.origins_m[frame], ink("--ink"), thin ? 0.7 : 2, alpha);
}

function drawArm() {
  const [pen, width, height] = sized(arm), [see, scale] = camera(width, height);
  const r = Math.ceil(data.radius_m * 2) / 2;
  for (let g = -r; g <= r + 1e-9; g += r / 4) {
    line(pen, see, [[g, -r, 0], [g, r, 0]], ink("--grid"), 0.7, 1);
    line(pen, see, [[-r, g, 0], [r, g, 0]], ink("--grid"), 0.7, 1);
  }
  for (const one of data.boxes) box(pen, see, one.lower_m, one.upper_m, one.name === "workspace" ? "#009E73" : "#D55E00");
  if (swept.checked) {
    const step = Math.max(1, Math.floor(last / 250));
    for (let k = 0; k <= last; k += step) posture(pen, see, scale, k, 0.12, true);
  }
  line(pen, see, data.origins_m.map(chain => chain[chain.length - 1]), ink("--ink"), 0.7, 0.5);
  posture(pen, see, scale, Math.round(at), 0.75, false);
}

function drawCurves(canvas, curves, unit, limit) {
  const [pen, width, height] = sized(canvas), left = 46, bottom = 20, top = 8;
  const values = curves.flatMap(curve => curve.values).filter(value => value !== null).concat([limit, 0]);
  const [low, high] = [Math.min(...values), Math.max(...values) || 1], end = data.time_s[last] || 1;
  const x = t => left + (width - left - 8) * t / end, y = v => top + (height - top - bottom) * (high - v) / (high - low || 1);
  pen.font = "12px sans-serif";
  pen.fillStyle = ink("--ink");
  for (const value of new Set([limit, high, low])) {
    pen.strokeStyle = value === limit ? "#D55E00" : ink("--grid");
    pen.beginPath(); pen.moveTo(left, y(value)); pen.lineTo(width - 8, y(value)); pen.stroke();
    if (value === limit || Math.abs(y(value) - y(limit)) > 12) pen.fillText(value.toFixed(0), 4, y(value) + (value === high ? 8 : 0));
  }
  pen.fillText(unit, left + 4, top + 10);
  pen.fillText(end.toFixed(0) + " s", width - 34, height - 5);
  curves.forEach((curve, k) => {
    pen.strokeStyle = colours[k % colours.length];
    pen.lineWidth = 1.3;
    pen.beginPath();
    curve.values.forEach((value, row) => value !== null && pen.lineTo(x(data.time_s[row]), y(value)));
    pen.stroke();
  });
  pen.strokeStyle = ink("--ink");
  pen.beginPath(); pen.moveTo(x(data.time_s[Math.round(at)]), top); pen.lineTo(x(data.time_s[Math.round(at)]), height - bottom); pen.stroke();
}

function draw() {
  const row = Math.round(at), clear = data.clearance_mm[row];
  slider.value = row;
  drawArm();
  drawCurves(document.getElementById("clearance"), [{values: data.clearance_mm}], "mm", data.minimum_mm);
  drawCurves(document.getElementById("speed"), data.speeds, "% of the limit", 100);
  words.textContent = `${data.time_s[row].toFixed(1)} s, move ${data.move[row]} of ${data.moves}` +
    (clear === null ? "" : `, ${clear.toFixed(0)} mm clear`);
}

function tick(now) {
  if (!running) return;
  const step_s = data.time_s[1] - data.time_s[0];
  at = (at + (now - before) / 1000 / step_s) % last;
  before = now;
  draw();
  requestAnimationFrame(tick);
}

play.onclick = () => {
  running = !running;
  play.textContent = running ? "Pause" : "Play";
  before = performance.now();
  requestAnimationFrame(tick);
};
slider.oninput = () => { at = Number(slider.value); draw(); };
swept.onchange = draw;
window.onresize = draw;
arm.onpointermove = event => {
  if (!event.buttons) return;
  yaw += event.movementX * 0.01;
  pitch = Math.min(1.5, Math.max(-1.5, pitch + event.movementY * 0.01));
  draw();
};
arm.onwheel = event => { event.preventDefault(); zoom = Math.min(8, Math.max(0.3, zoom * Math.exp(-event.deltaY * 0.001))); draw(); };
draw();
