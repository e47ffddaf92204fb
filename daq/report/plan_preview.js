// Draws a plan: the arm as capsules in 3-D with the volume that it sweeps, and curves over time with a cursor.
// Data: see plan_preview.py. The view is orthographic; x, y, z are those of the base frame.
"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const byId = id => document.getElementById(id);
const arm = byId("arm"), slider = byId("time"), last = data.time_s.length - 1;
const dark = matchMedia("(prefers-color-scheme: dark)");
const VIEWS = {home: [-0.7, 0.45], x: [Math.PI / 2, 0], y: [0, 0], z: [0, Math.PI / 2]};
const FONT = "14px system-ui, sans-serif";
let [yaw, pitch] = VIEWS.home, zoom = 1, running = false, at = 0, before = 0, sweptKey = "";
const sweptImage = document.createElement("canvas");
slider.max = last;

const ink = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const colourOf = link => (link < 0 ? ink("--base") : ink(`--axis-${link % 8}`));

function sized(canvas) {
  const ratio = window.devicePixelRatio || 1, box = canvas.getBoundingClientRect();
  canvas.width = Math.round(box.width * ratio);
  canvas.height = Math.round(box.height * ratio);
  return [plain(canvas, ratio), box.width, box.height];
}

function plain(canvas, ratio) {
  const pen = canvas.getContext("2d");
  pen.scale(ratio, ratio);
  pen.lineCap = pen.lineJoin = "round";
  return pen;
}

// Scale at which the whole scene is in sight from each of the views [pixels/m].
function fit(width, height) {
  const half = [0, 1, 2].map(k => (data.frame_m[1][k] - data.frame_m[0][k]) / 2 + 0.03);
  return Math.min(...Object.values(VIEWS).map(([turned, raised]) => {
    const [cy, sy, cp, sp] = [Math.cos(turned), Math.sin(turned), Math.cos(raised), Math.sin(raised)].map(Math.abs);
    const [across, up] = [cy * half[0] + sy * half[1], cp * half[2] + sp * (cy * half[1] + sy * half[0])];
    return Math.min(width / across, height / up) * 0.48;
  }));
}

// The place of a point on the screen, how near it is to the viewer [m], and the scale of a metre. Seen from above, a
// point that is farther away is higher on the screen.
function camera(width, height) {
  const scale = zoom * fit(width, height);
  const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
  const seen = point => {
    const [x, y, z] = point.map((value, k) => value - data.centre_m[k]);
    const away = cy * y - sy * x;
    return [cy * x + sy * y, cp * z + sp * away, sp * z - cp * away];
  };
  const see = point => { const [x, y] = seen(point); return [width / 2 + scale * x, height / 2 - scale * y]; };
  return [see, point => seen(point)[2], scale];
}

function line(pen, points, colour, thick, alpha = 1) {
  pen.strokeStyle = colour;
  pen.globalAlpha = alpha;
  pen.lineWidth = Math.max(thick, 0.7);
  pen.beginPath();
  points.forEach(([x, y], k) => (k ? pen.lineTo(x + 0.01, y) : pen.moveTo(x, y)));  // a line of no length draws nothing
  pen.stroke();
  pen.globalAlpha = 1;
}

function box(pen, see, one) {
  const corner = bits => see([0, 1, 2].map(k => (bits >> k & 1 ? one.upper_m[k] : one.lower_m[k])));
  const colour = ink(one.obstacle ? "--act" : "--ink");
  pen.setLineDash(one.obstacle ? [] : [6, 4]);
  for (let a = 0; a < 8; a++) for (const k of [1, 2, 4]) if (!(a & k)) line(pen, [corner(a), corner(a | k)], colour, 1.2);
  pen.setLineDash([]);
  if (one.obstacle) {
    pen.fillStyle = colour;
    pen.globalAlpha = 0.12;
    for (const face of [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]]) {
      pen.beginPath();
      face.forEach(bits => pen.lineTo(...corner(bits)));
      pen.fill();
    }
    pen.globalAlpha = 1;
  }
  const [x, y] = [0, 1, 2, 3, 4, 5, 6, 7].map(corner).reduce((a, b) => (b[1] < a[1] ? b : a));
  label(pen, one.name, x + 4, Math.max(y - 4, 14), colour);
}

function label(pen, text, x, y, colour, align = "left") {
  pen.font = FONT;
  pen.textAlign = align;
  pen.fillStyle = colour;
  pen.fillText(text, x, y);
}

function grid(pen, see) {
  const r = Math.ceil(data.radius_m * 2) / 2, step = data.grid_m;
  for (let g = -r; g <= r + 1e-9; g += step) {
    line(pen, [see([g, -r, 0]), see([g, r, 0])], ink("--line"), 0.7);
    line(pen, [see([-r, g, 0]), see([r, g, 0])], ink("--line"), 0.7);
  }
  [["x", [step, 0, 0]], ["y", [0, step, 0]], ["z", [0, 0, step]]].forEach(([name, end]) => {
    const [from, to] = [see([0, 0, 0]), see(end)];
    if (Math.hypot(to[0] - from[0], to[1] - from[1]) < 8) return;
    line(pen, [from, to], ink("--ink"), 1.5);
    label(pen, name, to[0] + 4, to[1] - 4, ink("--ink"));
  });
}

// Everywhere that a moving part has been, drawn as one shape with an outline, and below it its footprint on z = 0.
function sweptVolume(see, scale, width, height) {
  const key = [yaw, pitch, zoom, width, height, dark.matches].join();
  if (key === sweptKey) return;
  sweptKey = key;
  sweptImage.width = arm.width;
  sweptImage.height = arm.height;
  const ratio = window.devicePixelRatio || 1, pen = plain(sweptImage, ratio);
  // Postures between the rows, so that the outline of a fast move is smooth.
  const parts = Math.min(3, Math.max(1, Math.round(1500 / last)));
  const moving = data.capsules.map((one, k) => [one, k]).filter(([one]) => one.link >= 0);
  const all = stroke => {
    for (let n = 0; n <= last * parts; n++) {
      const row = Math.min(Math.floor(n / parts), last - 1), share = n / parts - row;
      for (const [one, k] of moving) {
        const [from, to] = [data.ends_m[row][k], data.ends_m[row + 1][k]];
        stroke(one, from.map((end, e) => end.map((value, c) => value + share * (to[e][c] - value))));
      }
    }
  };
  if (pitch > 0.02) {
    const [o, x, y] = [see([0, 0, 0]), see([1, 0, 0]), see([0, 1, 0])];
    pen.save();
    pen.transform(x[0] - o[0], x[1] - o[1], y[0] - o[0], y[1] - o[1], o[0], o[1]);
    pen.strokeStyle = ink("--footprint");
    all((one, [a, b]) => {
      pen.lineWidth = 2 * one.radius_m;
      pen.beginPath(); pen.moveTo(a[0], a[1]); pen.lineTo(b[0] + 1e-5, b[1]); pen.stroke();
    });
    pen.restore();
  }
  for (const [name, wider] of [["--swept-edge", 2], ["--swept", 0]]) {
    all((one, ends) => line(pen, ends.map(see), ink(name), 2 * one.radius_m * scale + wider));
  }
}

function drawArm() {
  const [pen, width, height] = sized(arm), [see, near, scale] = camera(width, height), row = Math.round(at);
  grid(pen, see);
  if (byId("swept").checked) {
    sweptVolume(see, scale, width, height);
    pen.globalAlpha = 0.6;
    pen.drawImage(sweptImage, 0, 0, width, height);
    pen.globalAlpha = 1;
  }
  for (const one of data.boxes) box(pen, see, one);
  line(pen, data.origins_m.map(chain => see(chain[chain.length - 1])), ink("--ink"), 0.7, 0.5);
  data.capsules
    .map((one, k) => ({one, ends: data.ends_m[row][k]}))
    .sort((a, b) => near(a.ends[0]) + near(a.ends[1]) - near(b.ends[0]) - near(b.ends[1]))
    .forEach(({one, ends}) => {
      const thick = 2 * one.radius_m * scale, places = ends.map(see);
      line(pen, places, ink("--paper"), thick + 3);
      line(pen, places, colourOf(one.link), thick, 0.92);
    });
  line(pen, data.origins_m[row].map(see), ink("--ink"), 2);
}

function ticks(low, high, most) {
  const raw = (high - low) / most || 1, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map(one => one * power).find(one => one >= raw);
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9; k++) found.push(k * step);
  return found;
}

// A place for curves: the pen, x of a time, and the lower edge; it has drawn the times and the cursor.
function timeline(canvas) {
  const [pen, width, height] = sized(canvas), bottom = height - 22, end = data.time_s[last] || 1;
  pen.font = FONT;
  const left = 30 + Math.min(180, Math.max(30, ...data.speeds.map(one => pen.measureText(one.name).width)));
  const x = t => left + (width - left - 12) * t / end;
  for (const t of ticks(0, end, Math.min(10, width / 70))) label(pen, `${t} s`, x(t), height - 5, ink("--soft"), "center");
  const now = x(data.time_s[Math.round(at)]);
  return [pen, x, left, width - 12, bottom, () => line(pen, [[now, 2], [now, bottom]], ink("--ink"), 1.2)];
}

function trace(pen, x, y, values) {
  pen.beginPath();
  let drawn = false;
  values.forEach((value, row) => {
    if (value === null) { drawn = false; return; }
    if (drawn) pen.lineTo(x(data.time_s[row]), y(value)); else pen.moveTo(x(data.time_s[row]), y(value));
    drawn = true;
  });
}

function drawClearance() {
  const [pen, x, left, right, bottom, cursor] = timeline(byId("clearance"));
  const known = data.clearance_mm.filter(value => value !== null), least = data.minimum_mm;
  const [low, high] = [Math.min(0, ...known), Math.max(least * 1.5, 1, ...known) * 1.05];
  const y = v => 6 + (bottom - 6) * (high - v) / (high - low);
  for (const tick of ticks(low, high, 4)) {
    line(pen, [[left, y(tick)], [right, y(tick)]], ink("--line"), 0.8);
    label(pen, tick, left - 6, y(tick) + 5, ink("--soft"), "right");
  }
  pen.fillStyle = ink("--act");
  pen.globalAlpha = 0.2;
  pen.fillRect(left, y(least), right - left, bottom - y(least));
  pen.globalAlpha = 1;
  line(pen, [[left, y(least)], [right, y(least)]], ink("--act"), 1.5);
  pen.strokeStyle = ink("--axis-0");
  pen.lineWidth = 1.8;
  trace(pen, x, y, data.clearance_mm);
  pen.stroke();
  cursor();
}

function drawSpeeds() {
  byId("speed").style.height = `${34 * data.speeds.length + 22}px`;
  const [pen, x, left, right, bottom, cursor] = timeline(byId("speed"));
  data.speeds.forEach((one, k) => {
    const floor = 34 * (k + 1), y = v => floor - 29 * v / 100;
    line(pen, [[left, floor], [right, floor]], ink("--line"), 0.8);
    label(pen, one.name, 18, floor - 9, ink("--ink"));
    pen.strokeStyle = pen.fillStyle = colourOf(k);
    pen.lineWidth = 1.5;
    trace(pen, x, y, one.values);
    pen.stroke();
    pen.lineTo(x(data.time_s[last]), floor); pen.lineTo(left, floor);
    pen.globalAlpha = 0.35;
    pen.fill();
    pen.globalAlpha = 1;
    pen.fillRect(0, floor - 20, 12, 12);
  });
  cursor();
}

function draw() {
  const row = Math.round(at), clear = data.clearance_mm[row];
  slider.value = row;
  drawArm();
  drawClearance();
  drawSpeeds();
  const near = clear !== null && clear < data.minimum_mm;
  byId("now").textContent = `${data.time_s[row].toFixed(1)} s, move ${data.move[row]} of ${data.moves}` +
    (clear === null ? "" : `, clearance ${clear.toFixed(0)} mm`) + (near ? ": TOO CLOSE" : "");
  byId("now").className = near ? "act" : "";
}

function tick(now) {
  if (!running) return;
  at = (at + (now - before) / 1000 / (data.time_s[1] - data.time_s[0])) % last;
  before = now;
  draw();
  requestAnimationFrame(tick);
}

byId("play").onclick = () => {
  running = !running;
  byId("play").textContent = running ? "Pause" : "Play";
  before = performance.now();
  requestAnimationFrame(tick);
};
slider.oninput = () => { at = Number(slider.value); draw(); };
byId("swept").onchange = window.onresize = dark.onchange = draw;
for (const button of document.querySelectorAll("[data-view]")) {
  button.onclick = () => { [yaw, pitch] = VIEWS[button.dataset.view]; draw(); };
}
for (const button of document.querySelectorAll("[data-zoom]")) {
  button.onclick = () => { zoomBy(Number(button.dataset.zoom)); };
}
function zoomBy(factor) { zoom = Math.min(8, Math.max(0.3, zoom * factor)); draw(); }
arm.onpointermove = event => {
  if (!event.buttons) return;
  yaw -= event.movementX * 0.01;
  pitch = Math.min(Math.PI / 2, Math.max(-Math.PI / 2, pitch + event.movementY * 0.01));
  draw();
};
arm.onwheel = event => { event.preventDefault(); zoomBy(Math.exp(-event.deltaY * 0.001)); };
draw();
