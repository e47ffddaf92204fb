// The console's page: what the server sends is kept for two minutes, drawn on canvases and written as text, never as
// markup. `drivegain` on the window holds it, for the tests.
const shown = { kept: 0, run: null, points: [], rows: [], events: [], status: null, received: 0,
  looks: [], guided: null,
  showAxis: (index, status) => showAxis(axes[index], status) };
window.drivegain = shown;
const byId = (id) => document.getElementById(id);
const axes = [];
let changed = true;

function element(name, text, className) {
  const made = document.createElement(name);
  if (text !== undefined) made.textContent = text;
  if (className) made.className = className;
  return made;
}

// Text with `commands` between back quotes.
function prose(name, text, className) {
  const made = element(name, undefined, className);
  text.split("`").forEach((part, k) => made.append(k % 2 ? element("code", part) : part));
  return made;
}

// CiA 402 states in words.
const STATES = {
  "NOT READY TO SWITCH ON": "starting",
  "SWITCH ON DISABLED": "power off",
  "READY TO SWITCH ON": "power off, ready",
  "SWITCHED ON": "power on, not enabled",
  "OPERATION ENABLED": "enabled",
  "QUICK STOP ACTIVE": "stopping",
  "FAULT REACTION ACTIVE": "fault, stopping",
  "FAULT": "fault, power off",
};

function number(value, digits) {
  return value === null || value === undefined ? "–" : value.toFixed(digits);
}

// A value with as many digits as the first two of its standard deviation; one that was held has none.
function withDeviation(value, std) {
  if (std === 0) return `${Number(value.toPrecision(4))} (fixed)`;
  const digits = std > 0 ? Math.min(10, Math.max(0, 1 - Math.floor(Math.log10(std)))) : 4;
  return `${number(value, digits)}\u00a0±\u00a0${number(std, digits)}`;
}

// ---- Axes

function buildAxis(axis, index) {
  const card = element("article");
  const head = element("header");
  const state = element("span", "no data", "state");
  head.append(element("h3", axis.name), state);
  const range = element("div", undefined, "range");
  const bar = element("div", undefined, "bar");
  const marker = element("i");
  bar.append(marker);
  range.append(element("span", number(axis.lower, 0)), bar, element("span", `${number(axis.upper, 0)} ${axis.unit}`));
  const values = element("p", "–", "values");
  const current = element("canvas");
  current.setAttribute("role", "img");
  current.setAttribute("aria-label", `Current of ${axis.name} over time`);
  const residual = element("canvas", undefined, "residual");
  residual.setAttribute("role", "img");
  residual.setAttribute("aria-label", `Measured less predicted current of ${axis.name} over time`);
  residual.hidden = true;
  const times = element("p", undefined, "times");
  const begin = element("span");
  times.append(begin, element("span", "now"));
  card.append(head, range, values, current, residual, times);
  byId("axes").append(card);
  axes.push({ ...axis, index, card, state, bar, marker, values, current, residual, begin });
}

// Why the bar of an axis is red; empty where it is not. The share is that of the range of the cell file.
function limitText(share) {
  if (share < 0) return "below its lower limit";
  if (share > 1) return "above its upper limit";
  if (share < NEAR) return "near its lower limit";
  return share > 1 - NEAR ? "near its upper limit" : "";
}
const NEAR = 0.03;

function showAxis(axis, status) {
  const now = status.axes[axis.index];
  if (!now) return;
  const words = STATES[now.state] || now.state;
  axis.card.classList.add("live");
  axis.state.textContent = status.old ? `last: ${words}` : now.silent ? `${words}, DOES NOT ANSWER` : words;
  axis.state.title = now.state;
  axis.state.className = `state${now.fault || now.silent ? " fault" : now.power && !status.old ? " power" : ""}`;
  const share = (now.position - axis.lower) / (axis.upper - axis.lower);
  const near = limitText(share);
  axis.values.textContent =
    `position ${number(now.position, 2)} ${axis.unit}${near && `, ${near}`}, ` +
    `current ${number(now.current, 3)} ${axis.current_unit}`;
  axis.marker.style.left = `calc(${100 * Math.min(1, Math.max(0, share))}% - 0.17rem)`;
  axis.bar.classList.toggle("near", near !== "");
}

// ---- Curves

function since(list, time) {
  let low = 0, high = list.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (list[middle][0] < time) low = middle + 1; else high = middle;
  }
  return list.slice(low);
}

function niceStep(range, most) {
  const power = 10 ** Math.floor(Math.log10(range / most));
  return [1, 2, 5, 10].map((one) => one * power).find((one) => range / one <= most);
}

// A chart: lines and bands over time, one scale for all of them. A line is {points, color}, of [time, value] pairs.
function draw(canvas, colors, begin, end, lines, bands, unit) {
  const scale = window.devicePixelRatio || 1;
  const width = canvas.clientWidth, height = canvas.clientHeight;
  if (!width) return;
  if (canvas.width !== Math.round(width * scale) || canvas.height !== Math.round(height * scale)) {
    canvas.width = Math.round(width * scale);
    canvas.height = Math.round(height * scale);
  }
  const pen = canvas.getContext("2d");
  pen.setTransform(scale, 0, 0, scale, 0, 0);
  pen.clearRect(0, 0, width, height);
  let low = Infinity, high = -Infinity;
  for (const { points } of lines) {
    for (const [, value] of points) {
      if (value !== null) { low = Math.min(low, value); high = Math.max(high, value); }
    }
  }
  for (const { points, half } of bands) {
    for (const [, value] of points) {
      if (value !== null) { low = Math.min(low, value - half); high = Math.max(high, value + half); }
    }
  }
  if (low > high) return;
  const spare = Math.max(0.08 * (high - low), 1e-3);
  low -= spare; high += spare;
  const left = 46, bottom = 4;
  const x = (time) => left + (width - left - 4) * (time - begin) / (end - begin);
  const y = (value) => bottom + (height - 2 * bottom) * (high - value) / (high - low);
  const step = niceStep(high - low, height > 80 ? 6 : 3);
  pen.font = "12px system-ui, sans-serif";
  pen.textAlign = "right";
  pen.textBaseline = "middle";
  pen.lineWidth = 1;
  // Multiples of the step: a sum of steps passes zero at 3e-17.
  for (let count = Math.ceil(low / step); count * step <= high; count += 1) {
    const tick = count * step;
    pen.strokeStyle = colors.line;
    pen.beginPath(); pen.moveTo(left, y(tick)); pen.lineTo(width - 4, y(tick)); pen.stroke();
    pen.fillStyle = colors.quiet;
    const text = `${Number(tick.toPrecision(3))}`;
    pen.fillText(text, left - 4, Math.min(height - 7, Math.max(7, y(tick))));
  }
  pen.textAlign = "left";
  pen.fillText(unit, left + 4, 8);
  for (const { points, half, color } of bands) {
    pen.fillStyle = color;
    for (const part of stretches(points)) {
      pen.beginPath();
      part.forEach(([time, value]) => pen.lineTo(x(time), y(value + half)));
      part.reverse().forEach(([time, value]) => pen.lineTo(x(time), y(value - half)));
      pen.fill();
    }
  }
  for (const { points, color, dash } of lines) {
    pen.strokeStyle = color;
    pen.lineWidth = dash ? 2.5 : 1.5;
    pen.setLineDash(dash || []);
    for (const part of stretches(points)) {
      pen.beginPath();
      part.forEach(([time, value]) => pen.lineTo(x(time), y(value)));
      pen.stroke();
    }
  }
  pen.setLineDash([]);
}

function stretches(points) {
  const found = [[]];
  for (const point of points) {
    if (point[1] === null) { if (found.at(-1).length) found.push([]); } else found.at(-1).push(point);
  }
  return found;
}

function drawAll() {
  if (!changed || !shown.points.length) return;
  changed = false;
  const style = getComputedStyle(document.documentElement);
  const colors = {};
  for (const name of ["line", "quiet", "current", "predicted", "band", "residual"]) {
    colors[name] = style.getPropertyValue(`--${name}`);
  }
  const end = shown.points.at(-1)[0];
  const begin = end - Number(byId("span").value);
  const points = since(shown.points, begin), rows = since(shown.rows, begin);
  for (const axis of axes) {
    axis.begin.textContent = `${number(begin - end, 0)} s`;
    const half = shown.status.band[axis.index] || 0;
    const measured = points.map((point) => [point[0], point[1 + axes.length + axis.index]]);
    const predicted = rows.map((row) => [row[0], row[1 + axis.index]]);
    const residual = rows.map((row) => [row[0], row[1 + axes.length + axis.index]]);
    draw(axis.current, colors, begin, end,
      [{ points: measured, color: colors.current }, { points: predicted, color: colors.predicted, dash: [7, 4] }],
      [{ points: predicted, half, color: colors.band }], axis.current_unit);
    axis.residual.hidden = !shown.rows.length;
    if (shown.rows.length) {
      const zero = residual.map(([time, value]) => [time, value === null ? null : 0]);
      draw(axis.residual, colors, begin, end, [{ points: residual, color: colors.residual }],
        [{ points: zero, half, color: colors.band }], axis.current_unit);
    }
  }
}

// ---- Words and figures

const PHASES = {
  waiting: "No recording runs. Start one in a terminal: `drivegain record` or `drivegain recalibrate`.",
  running: "The drives are prepared…",
  watching: "drivegain monitor watches; nothing is recorded.",
  ended: "The last run has ended.",
};

function grouped(count) {
  return String(count).replace(/\B(?=(\d{3})+$)/g, "\u202f");
}

function showStatus(status) {
  const run = shown.run;
  const running = status.phase === "running";
  const blind = status.alarm && (running || status.phase === "watching");
  const phase = blind ? "This page does not show the cell as it is now." : running && run ? "Recording" : PHASES[status.phase];
  byId("phase").replaceChildren(...prose("p", phase).childNodes);
  byId("blind").textContent = status.alarm && `${status.alarm}.`;
  byId("blind").hidden = !status.alarm;
  byId("stop").disabled = !running;
  const watching = status.phase === "watching";
  byId("log").textContent = run && run.log ? run.log.split("/").at(-1) : watching ? "no recording" : "no run yet";
  byId("log").title = run && run.log ? run.log : "";
  byId("moves").value = status.moves ? status.done / status.moves : 0;
  byId("done").textContent = status.moves ? `${status.done} of ${status.moves} moves` : "";
  const loads = Object.entries(status.bus_load).map(([bus, load]) => `${bus} ${number(100 * load, 0)} %`).join(", ");
  const figures = [
    ["Samples", grouped(status.samples)],
    ["SYNC cycles lost", grouped(status.lost), status.lost > 0],
    ["Missing answers", grouped(status.missing), status.missing > 0],
  ];
  // What is not known has no card: a dash would say that something is missing.
  const active = running || watching;
  if (active && status.rate_hz) {
    figures.push(["Sample rate", `${number(status.rate_hz, 0)} Hz${status.simulated ? ", simulated" : ""}`]);
  }
  if (active && loads) figures.push([`Bus load, ${watching ? "measured" : "computed"}`, loads]);
  else if (active && status.simulated) figures.push(["Bus load", "none: simulated"]);
  if (status.free_bytes !== null) figures.push(["Disk free", `${number(status.free_bytes / 1e9, 1)} GB`]);
  // The recorder never waits for this page; the log has what the page missed.
  if (status.dropped > 0) figures.push(["Missed here, in the log", grouped(status.dropped)]);
  const list = byId("figures");
  if (list.children.length !== figures.length) {
    list.replaceChildren(...figures.map(() => {
      const entry = element("div");
      entry.append(element("dt"), element("dd"));
      return entry;
    }));
  }
  figures.forEach(([name, text, alarm], index) => {
    const [label, value] = list.children[index].children;
    label.textContent = name;
    value.textContent = text;
    value.className = alarm ? "alarm" : "";
  });
  axes.forEach((axis) => showAxis(axis, status));
  byId("remark").textContent = status.remark;
  byId("remark").hidden = !status.remark;
  document.querySelectorAll(".predicted-only").forEach((one) => { one.hidden = !shown.rows.length; });
  showEnd(status);
  showStop(status.stop);
}

function showEnd(status) {
  const notice = byId("ended");
  const { end, result } = status;
  notice.hidden = !(end || result);
  if (notice.hidden) return;
  const words = [];
  if (result) words.push(result.valid ? "The recording is complete." : `The recording is INVALID: ${result.reason}.`);
  if (end && !end.ok) words.push(`It ended early: ${end.text}.`);
  if (end && !end.axes_stopped) words.push("NOT ALL AXES ARE CONFIRMED STOPPED: look at the robot.");
  else if (end && !end.ok) words.push("The axes are stopped.");
  notice.replaceChildren(...prose("p", words.join(" ") || "The program has ended.").childNodes);
  notice.classList.toggle("good", Boolean(!end || end.ok) && Boolean(!result || result.valid));
}

function showStop(stop) {
  byId("stopped").hidden = !stop;
  if (!stop) return;
  byId("stopped").textContent = `Stop asked at ${stop.at}: ${stop.text}.`;
  byId("stopped").classList.toggle("good", Boolean(stop.axes_stopped));
}

const KEPT_LINES = 200;
const FEW_LINES = 8;  // as many lines of a list are shown at first; the newest are above

// A list that scrolls by itself hides its rest where a browser draws no scroll bar; a button names it.
function showMore(name) {
  const list = byId(name), button = byId(`more-${name}`), count = list.children.length;
  const short = !list.classList.contains("whole");
  button.hidden = count <= FEW_LINES;
  button.textContent = short ? `Show all ${count}` : `Show the last ${FEW_LINES}`;
  [...list.children].forEach((line, index) => { line.hidden = short && index >= FEW_LINES; });
}

function addEvents(events) {
  for (const event of events) {
    if (event.kind === "move start" || event.kind === "move end") continue;
    const line = element("li");
    line.append(element("span", `${number(event.time_s, 3)} s `, "quiet"));
    line.append(element("strong", event.axis ? `${event.axis} ` : "", event.alarm ? "alarm" : ""));
    line.append(prose("span", (event.alarm ? "⚠ " : "") + event.text, event.alarm ? "alarm" : ""));
    if (event.remedy) line.append(prose("span", `→ ${event.remedy}`, "remedy"));
    byId(event.alarm ? "alarms" : "events").prepend(line);
  }
  for (const name of ["alarms", "events"]) {
    const list = byId(name);
    while (list.children.length > KEPT_LINES) list.lastChild.remove();
    showMore(name);
  }
  byId("faults").hidden = !byId("alarms").children.length;
  byId("quiet").hidden = byId("events").children.length > 0;
}

// ---- Results

function table(headings, rows) {
  const made = element("table");
  const head = element("tr");
  // A column of words is aligned to the left, one of numbers to the right.
  const kinds = headings.map((_, k) => (rows.every((row) => /^[-+–\d]/.test(row[k])) ? "" : "text"));
  headings.forEach((text, k) => head.append(element("th", text, kinds[k])));
  made.append(head);
  for (const row of rows) {
    const line = element("tr");
    row.forEach((text, k) => line.append(element("td", text, k ? kinds[k] : "")));
    made.append(line);
  }
  const box = element("div", undefined, "table");
  box.append(made);
  return box;
}

function signed(value, digits, unit) {
  return value === null ? "–" : `${value > 0 ? "+" : ""}${number(value, digits)}\u00a0${unit}`;
}

function utc(iso) {
  const time = new Date(iso);
  return Number.isNaN(time.getTime()) ? iso : `${time.toISOString().slice(0, 16).replace("T", " ")} UTC`;
}

function showResults(found) {
  const parts = found.problems.map((text) => prose("p", text, "alarm"));
  if (found.gains) {
    parts.push(element("h3", `Gains of ${found.gains.file}, fitted ${utc(found.gains.created)}; error on ${found.gains.error}`));
    parts.push(table(["axis", "gain ± σ", "from nameplate", "error"],
      found.gains.axes.map((one) => [one.axis, `${withDeviation(one.value, one.std)} ${one.unit}`,
        signed(one.change_percent, 2, "%"), `${number(one.error_percent, 2)}\u00a0%`])));
  } else parts.push(prose("p", "No calibration yet. After the recordings: `drivegain fit LOG … --out calibration.yaml`"));
  if (found.report) {
    const link = element("a", "Open the report");
    link.href = "report";
    link.target = "_blank";
    link.rel = "noopener";
    parts.push(link);
  }
  if (found.session) {
    const { session } = found;
    parts.push(element("h3", `${session.kind} ${session.session}: ${session.outcome}`));
    session.sentences.forEach((text) => parts.push(element("p", text)));
    if (session.waits) parts.push(element("p", "A proposal waits for approval. Type in a terminal:", "alarm"));
    else if (session.problem) parts.push(prose("p", session.problem));
    for (const text of session.to_do) {
      // A line is words, a command, or words before a command; one between back quotes is part of the words.
      const [, words, command] = /^(.*?)((?<!`)drivegain [^`]*)?$/.exec(text);
      if (words) parts.push(prose("p", words));
      if (command) parts.push(element("pre", command));
    }
  }
  if (found.history) {
    parts.push(element("h3", `History: ${found.history.calibrations} calibrations`));
    if (found.history.problem) parts.push(prose("p", found.history.problem, "alarm"));
    parts.push(table(["axis", "since baseline", "in σ", "drift"], found.history.axes.map((one) => [one.axis,
      signed(one.change_percent, 2, "%"), one.change_sigmas === null ? "–" : number(Math.abs(one.change_sigmas), 1),
      one.alarm || "none"])));
    parts.push(element("pre", found.history.command));
  }
  byId("results").replaceChildren(...parts);
}

// ---- A guided session

function drawn(tag, attributes, text) {
  const made = document.createElementNS(byId("precision").namespaceURI, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  if (text !== undefined) made.textContent = text;
  return made;
}

// Number of a block by its name, from 1.
function blockNumber(name) {
  const [, digits] = /^block-(\d+)-/.exec(name) || [];
  return Number(digits || 0);
}

// Quick looks at the gains since the last block that was judged.
function newLooks(precision) {
  const judged = precision ? precision.progress.at(-1).blocks : 0;
  return shown.looks.filter((look) => blockNumber(look.block) > judged);
}

function byAxis(names, values) {
  return Object.fromEntries(names.map((name, k) => [name, values[k]]));
}

/** Points of the picture: the estimate after each block, then the quick ones of the moves since. */
function precisionPoints(precision, looks) {
  const progress = precision ? precision.progress : [];
  const last = progress.at(-1);
  const heldOut = last ? last.motion_s - last.fitted_s : 0;
  const judged = progress.map((one) => ({ motion_s: one.motion_s, std: byAxis(precision.axes, one.std_percent), quick: false }));
  const quick = looks.map((look) => ({
    motion_s: look.motion_s + heldOut,
    std: byAxis(look.gains.map((gain) => gain.axis), look.gains.map((gain) => gain.std_percent)),
    quick: true,
  }));
  return [...judged, ...quick];
}

/** σ of each gain over the time of motion, both axes logarithmic: a fall as 1/√time is a straight line. */
function drawPrecision(points, axes, target, leftOver) {
  const [width, height, left, right, top, bottom] = [640, 260, 48, 70, 12, 32];
  const values = [target, ...points.flatMap((one) => Object.values(one.std))];
  const end = points.at(-1);
  const first = points[0].motion_s;
  const last = Math.max(first * 2, end.motion_s + leftOver);
  const [low, high] = [Math.min(...values) / 1.3, Math.max(...values) * 1.3];
  const x = (time) => left + (width - left - right) * Math.log(time / first) / Math.log(last / first);
  const y = (value) => top + (height - top - bottom) * Math.log(high / value) / Math.log(high / low);
  const picture = byId("precision");
  picture.replaceChildren(drawn("title", {}, `Standard deviation of each gain after ${points.length} looks; target ${target} %`));
  for (const value of [0.1, 0.2, 0.5, 1, 2, 5, 10, 20].filter((one) => one > low && one < high)) {
    picture.append(drawn("line", { class: "grid", x1: left, x2: width - right, y1: y(value), y2: y(value) }));
    picture.append(drawn("text", { x: left - 6, y: y(value) + 4, "text-anchor": "end" }, `${value} %`));
  }
  picture.append(drawn("line", { class: "target", x1: left, x2: width - right, y1: y(target), y2: y(target) }));
  picture.append(drawn("text", { x: width - right + 6, y: y(target) + 4 }, "target"));
  const ends = axes.map((name) => ({ name, value: end.std[name] })).sort((a, b) => b.value - a.value);
  let free = 0;
  for (const { name, value } of ends) {
    const kind = value > target ? "sigma coarse" : "sigma";
    const line = points.map((one) => `${x(one.motion_s)},${y(one.std[name])}`).join(" ");
    picture.append(drawn("polyline", { class: kind, points: line }));
    for (const one of points) {
      const form = one.quick ? `${kind} quick` : kind;
      picture.append(drawn("circle", { class: form, cx: x(one.motion_s), cy: y(one.std[name]), r: one.quick ? 2 : 3 }));
    }
    free = Math.max(y(value) + 4, free + 14); // names do not cover each other
    picture.append(drawn("text", { x: x(end.motion_s) + 8, y: free }, `${name} ${number(value, 2)} %`));
  }
  for (const time of [first, end.motion_s]) {
    picture.append(drawn("text", { x: x(time), y: height - 8, "text-anchor": "middle" }, `${Math.round(time)} s`));
  }
}

function duration(seconds) {
  return seconds < 120 ? `${Math.round(seconds)} s` : `${Math.round(seconds / 60)} min`;
}

// The quick estimate after the last move, or what it lacks.
function quickText(look) {
  if (look.missing) return `No gains yet: ${look.missing}.`;
  const listed = look.gains.map((gain) =>
    `${gain.axis} ${Number(gain.value.toPrecision(4))} ± ${number(gain.std_percent, 2)} %`);
  const besideTarget = `target ± ${look.gains[0].target_percent} %: ${listed.join(", ")}.`;
  if (look.is_held_out) return `This block is held out, its moves do not count. Quick estimate so far, ${besideTarget}`;
  const head = `Quick estimate after move ${look.move} of ${look.moves}, ${besideTarget}`;
  if (look.left_s <= 0) return `${head} All at the target so far; the end of the block decides.`;
  return `${head} ${look.gains[0].axis} is worst (${look.why}): about ${duration(look.left_s)} left.`;
}

function takeLook(look) {
  const last = shown.looks.at(-1);
  if (!look || !look.gains.length || look.is_held_out) return;
  if (last && last.block === look.block && last.move === look.move) return;
  shown.looks.push(look);
}

function showGuided() {
  const { guided, status } = shown;
  byId("guided").hidden = !guided;
  if (!guided) return;
  const look = status && status.phase === "running" ? status.quick : null;
  const moving = movingRun();
  byId("stage").textContent = `Stage: ${guided.stage}. Recorded: ${guided.blocks.join(", ") || "nothing yet"}.`;
  byId("next-step").textContent = moving ? `The robot moves: ${moving}` : guided.next_step;
  const parts = [];
  const { precision, acceptance } = guided;
  const looks = newLooks(precision);
  const points = precisionPoints(precision, looks);
  byId("precision").toggleAttribute("hidden", !points.length);
  if (points.length) {
    const gains = looks.length ? looks.at(-1).gains : [];
    const names = precision ? precision.axes : gains.map((gain) => gain.axis);
    const target = precision ? precision.target_percent : gains[0].target_percent;
    drawPrecision(points, names, target, looks.length ? looks.at(-1).left_s : precision.left_s);
  }
  if (look) parts.push(element("p", quickText(look)));
  if (guided.missing) {
    parts.push(element("p", `Not reached: ${guided.missing}`, "alarm"));
    guided.would_help.forEach((text) => parts.push(element("p", `Would help: ${text}`)));
  } else if (guided.stage === "record" && precision && precision.left_s && !look) {
    const why = precision.why ? ` ${precision.worst} is worst: ${precision.why}.` : "";
    parts.push(element("p", `About ${duration(precision.left_s)} of motion are left at this rate.${why}`));
  }
  if (acceptance) {
    const verdict = acceptance.accepted ? "Accepted" : "Not accepted";
    parts.push(element("p", `${verdict}: ${acceptance.remark}`, acceptance.accepted ? "" : "alarm"));
  }
  byId("outlook").replaceChildren(...parts);
}

// Name of the run that moves the robot now; empty where none does.
function movingRun() {
  const { status, run } = shown;
  if (!status || status.phase !== "running" || status.result || !run || !run.log) return "";
  return run.log.split("/").at(-1).replace(/\.mcap$/, "");
}

// What the session's section shows of the recorder, as text to compare.
function sessionKey() {
  return JSON.stringify([movingRun(), shown.status && shown.status.quick]);
}

function takeGuided(guided) {
  const isOther = !shown.guided || !guided || shown.guided.session !== guided.session;
  if (isOther && shown.guided) shown.looks = [];
  shown.guided = guided;
  showGuided();
}

let before = "";
async function look() {
  try {
    const text = await (await fetch("results")).text();
    const found = JSON.parse(text);
    // The stop is shown by this way too: the curves may be stalled.
    if (found.stop) showStop(found.stop);
    if (text !== before && "problems" in found) {
      showResults(found);
      takeGuided(found.guided);
    }
    before = text;
  } catch { /* the stream reports it */ }
  setTimeout(look, 1000);
}

async function stop() {
  byId("stop").disabled = true;
  try {
    showStop(await (await fetch("stop", { method: "POST" })).json());
  } catch {
    showStop({ at: "now", text: "the console did not answer: press Ctrl-C in the recorder's terminal, or the emergency stop" });
  }
}

// ---- Start

function take(message) {
  const { status, new: fresh } = message;
  const before = sessionKey();
  if ("run" in fresh) {
    Object.assign(shown, { run: fresh.run, points: [], rows: [], events: [], received: 0 });
    byId("alarms").replaceChildren();
    byId("events").replaceChildren();
    addEvents([]);
  }
  for (const name of ["points", "rows", "events"]) {
    if (!fresh[name]) continue;
    shown[name].push(...fresh[name]);
    shown[name].splice(0, shown[name].length - shown.kept);
  }
  shown.received += (fresh.points || []).length;
  shown.status = status;
  changed = true;
  takeLook(status.quick);
  if (sessionKey() !== before) showGuided();
  addEvents(fresh.events || []);
  showStatus(status);
}

async function begin() {
  const cell = await (await fetch("cell")).json();
  shown.kept = cell.kept_points;
  byId("cell").textContent = cell.cell;
  document.title = `${cell.cell} – drivegain console`;
  cell.axes.forEach(buildAxis);
  const stream = new EventSource("curves");
  stream.onmessage = (event) => take(JSON.parse(event.data));
  stream.onerror = () => { byId("phase").textContent = "The console does not answer; the recording goes on without it."; };
  byId("stop").addEventListener("click", stop);
  for (const name of ["alarms", "events"]) {
    byId(`more-${name}`).addEventListener("click", () => { byId(name).classList.toggle("whole"); showMore(name); });
  }
  byId("span").addEventListener("change", () => { changed = true; });
  window.addEventListener("resize", () => { changed = true; });
  const frame = () => { drawAll(); requestAnimationFrame(frame); };
  frame();
  look();
}

begin();
