"use strict";
(() => {
  const data = JSON.parse(document.getElementById("player-data").textContent);
  const UNIT = 0.01;                  // packed numbers are hundredths of a metre or radian
  const POINT = 4 / 3;                // CSS pixels in a point: widths of lines are given in points
  const NEAR = 0.5;                   // steps this near in time count as the same moment [s]
  const $ = (name) => document.getElementById("player-" + name);
  const INK = "#3c4043", RING = "#e3001b", ROAD = "#f59f00", CHOSEN = "#111418";
  const COSTS = [[42, 157, 92], [240, 190, 60], [193, 18, 31]];   // cheap, middling, dear
  const state = { scene: 0, method: null, rollout: 0, agent: null, time: data.now, playing: false, view: null, last: null };

  // --- unpacking: dpa/report/packing.py says how numbers are written ---------------------------------------------

  const ALPHABET = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
  const LETTER = Object.fromEntries([...ALPHABET].map((letter, value) => [letter, value]));

  function unpackNumbers(text) {
    const numbers = [];
    for (let i = 0, value = 0, shift = 0; i < text.length; i++) {
      const letter = LETTER[text[i]];
      value += (letter & 31) * 2 ** shift;
      shift += 5;
      if (letter < 32) { numbers.push(value % 2 ? -(value - 1) / 2 : value / 2); value = shift = 0; }
    }
    return numbers;
  }

  function unpackTrack(text, steps) {
    const numbers = unpackNumbers(text), runs = numbers[0] || 0, poses = Array(steps).fill(null);
    const pose = [0, 0, 0], change = [0, 0, 0];
    let next = 1 + 2 * runs, seen = 0;
    for (let run = 0; run < runs; run++) {
      const first = numbers[1 + 2 * run], length = numbers[2 + 2 * run];
      for (let step = first; step < first + length; step++, seen++) {
        for (let k = 0; k < 3; k++) {
          const number = numbers[next++] || 0;    // zeros at the end are left out
          change[k] = seen < 2 ? number : change[k] + number;
          pose[k] += change[k];
        }
        poses[step] = pose.map((value) => value * UNIT);
      }
    }
    return poses;
  }

  function unpackLine(text) {
    const numbers = unpackNumbers(text), points = [];
    let x = 0, y = 0, i = 0;
    do {
      x += numbers[i] || 0; y += numbers[i + 1] || 0;
      points.push([x * UNIT, y * UNIT]);
      i += 2;
    } while (i < numbers.length);
    return points;
  }

  function unpackLayer(layer) {
    const path = new Path2D(), dots = [];
    for (const text of layer.lines) {
      const points = unpackLine(text);
      if (layer.paint === "dot") { dots.push(...points); continue; }
      points.forEach(([x, y], i) => i ? path.lineTo(x, y) : path.moveTo(x, y));
      if (layer.paint === "area") path.closePath();
    }
    return { ...layer, path, dots };
  }

  // Sets of agents for each step; `agentOf` turns a row into the agent's place in the scene.
  function unpackFlags(runs, first, steps, agentOf) {
    const sets = Array.from({ length: steps }, () => new Set());
    for (const [row, spans] of Object.entries(runs)) {
      for (let i = 0; i < spans.length; i += 2) {
        for (let step = 0; step < spans[i + 1]; step++) sets[first + spans[i] + step].add(agentOf(Number(row)));
      }
    }
    return sets;
  }

  const unpacked = new Map();
  function sceneAt(index) {
    if (!unpacked.has(index)) {
      const scene = data.scenes[index], same = (agent) => agent;
      const log = {
        tracks: scene.log.tracks.map((text) => unpackTrack(text, data.steps)),
        collides: unpackFlags(scene.log.collides, 0, data.steps, same),
        offroad: unpackFlags(scene.log.offroad, 0, data.steps, same),
      };
      log.left = log.offroad.map(leftSince(log));
      unpacked.set(index, { ...scene, layers: scene.map.map(unpackLayer), log, fit: scene.view.map((value) => value * UNIT),
                            memo: new Map(), dearest: new Map() });
    }
    return unpacked.get(index);
  }

  // Many agents stand in a drive or walk beside the road all the time; what tells is who was on it and left it.
  function leftSince(log) {
    const outside = new Set();
    log.tracks.forEach((track, agent) => {
      const start = track[data.now] ? data.now : track.findIndex(Boolean);
      if (start >= 0 && log.offroad[start].has(agent)) outside.add(agent);
    });
    return (set) => new Set([...set].filter((agent) => !outside.has(agent)));
  }

  const methodsOf = (scene) => Object.keys(scene.rollouts);

  // The log up to now, then what the rollout did with the agents that were there; the others are not simulated.
  function rolloutAt(scene, method, index) {
    const key = index + " " + method;
    if (!scene.memo.has(key)) {
      const given = scene.rollouts[method], kept = given.kept[index], first = data.now + 1, steps = data.steps - first;
      const tracks = scene.log.tracks.map((track) => track.slice(0, first).concat(Array(steps).fill(null)));
      kept.tracks.forEach((text, row) => {
        const agent = scene.present[row];
        tracks[agent] = scene.log.tracks[agent].slice(0, first).concat(unpackTrack(text, steps));
      });
      const flags = (name) => {
        const sets = unpackFlags(kept[name], first, data.steps, (row) => scene.present[row]);
        return scene.log[name].map((set, step) => step < first ? set : sets[step]);
      };
      const offroad = flags("offroad"), left = offroad.map(leftSince(scene.log));
      scene.memo.set(key, { tracks, collides: flags("collides"), offroad, left, agents: unpackAgents(scene, given, kept) });
    }
    return scene.memo.get(key);
  }

  // Ranked agents, the one that pays most first.
  function unpackAgents(scene, given, kept) {
    const count = given.features.length, shares = unpackNumbers(kept.share), all = kept.paid.reduce((a, b) => a + b, 0);
    const root = given.features.map(({ weight }) => Math.sqrt(weight));
    const agents = given.ranked.map((row, i) => ({
      agent: scene.present[row],
      paid: kept.paid[i],
      part: all > 0 ? kept.paid[i] / all : 0,
      shares: given.features.map(({ name }, k) => [name, shares[i * count + k] || 0]),
      ...unpackCoupling(given, kept, i, root),
    }));
    return agents.sort((a, b) => b.paid - a.paid);
  }

  // Features at the valid steps of an agent, and of each pair of steps what it costs.
  function unpackCoupling(given, kept, i, root) {
    const step = given.stride * data.seconds, times = [];
    for (let k = 0; k < given.valid[i].length; k += 2) {
      for (let n = 0; n < given.valid[i][k + 1]; n++) times.push((given.valid[i][k] + n + 1) * step);
    }
    const rollout = unpackFeatures(kept.features[i], times.length, root.length), log = unpackFeatures(given.log[i], times.length, root.length);
    const between = (a, b) => Math.hypot(...root.map((weight, k) => weight * (a[k] - b[k])));
    const partner = unpackNumbers(kept.coupling[i]);
    const pairs = times.map((time, row) => {
      const column = times.findIndex((other) => Math.abs(other - step * (1 + (partner[row] || 0))) < step / 2);
      return { rollout: time, log: times[column], cost: between(rollout[row], log[column]), values: [rollout[row], log[column]] };
    });
    return { step, times, pairs, costs: () => rollout.map((mine) => log.map((theirs) => between(mine, theirs))) };
  }

  function unpackFeatures(text, steps, count) {
    const numbers = unpackNumbers(text), values = Array(count).fill(0);
    return Array.from({ length: steps }, (_, step) => values.map((_, k) => (values[k] += numbers[step * count + k] || 0) * UNIT));
  }

  // --- geometry ------------------------------------------------------------------------------------------------

  function poseAt(track, time) {
    const step = Math.min(Math.floor(time), data.steps - 1), part = time - step;
    const from = track[step], to = track[step + 1];
    if (!from || !to || part === 0) return from || null;
    const turn = Math.atan2(Math.sin(to[2] - from[2]), Math.cos(to[2] - from[2]));
    return [from[0] + part * (to[0] - from[0]), from[1] + part * (to[1] - from[1]), from[2] + part * turn];
  }

  function corners(pose, size) {
    const cos = Math.cos(pose[2]), sin = Math.sin(pose[2]), l = size[0] * UNIT / 2, w = size[1] * UNIT / 2;
    return [[l, w], [-l, w], [-l, -w], [l, -w]].map(([a, b]) => [pose[0] + a * cos - b * sin, pose[1] + a * sin + b * cos]);
  }

  // --- the pictures --------------------------------------------------------------------------------------------

  function drawMap(ctx, scene, scale) {
    const pixel = 1 / scale;
    ctx.lineJoin = ctx.lineCap = "round";
    for (const { paint, color, width, path, dots } of scene.layers) {
      ctx.fillStyle = ctx.strokeStyle = color;
      ctx.setLineDash(paint === "dashes" ? [4 * pixel, 5 * pixel] : []);
      if (paint === "area") ctx.fill(path);
      else if (paint === "dot") dots.forEach(([x, y]) => disc(ctx, x, y, width / 2 * POINT * pixel));
      else { ctx.lineWidth = paint === "lane" ? width : width * POINT * pixel; ctx.stroke(path); }
    }
    ctx.setLineDash([]);
  }

  function circle(ctx, x, y, radius) {
    ctx.beginPath();
    ctx.arc(x, y, radius, 0, 2 * Math.PI);
  }

  function disc(ctx, x, y, radius) {
    circle(ctx, x, y, radius);
    ctx.fill();
  }

  function drawPaths(ctx, scene, tracks, time, scale) {
    const now = Math.floor(time);
    ctx.lineCap = "butt";
    tracks.forEach((track, agent) => {
      ctx.strokeStyle = data.classes[scene.class[agent]].color;
      for (const [from, to, alpha, width] of [[0, now, 0.25, 1], [now, data.steps - 1, 0.5, 1.8]]) {
        ctx.globalAlpha = alpha;
        ctx.lineWidth = width / scale;
        ctx.beginPath();
        for (let step = from, down = false; step <= to; step++) {
          const pose = track[step];
          if (pose) down ? ctx.lineTo(pose[0], pose[1]) : ctx.moveTo(pose[0], pose[1]);
          down = Boolean(pose);
        }
        ctx.stroke();
      }
    });
    ctx.globalAlpha = 1;
  }

  function outline(ctx, points) {
    ctx.beginPath();
    points.forEach(([x, y], i) => i ? ctx.lineTo(x, y) : ctx.moveTo(x, y));
    ctx.closePath();
  }

  function drawLights(ctx, scene, time, scale) {
    const step = Math.floor(time);
    for (const { at, groups } of scene.lights) {
      if (groups[step] === null) continue;
      const [x, y] = [at[0] * UNIT, at[1] * UNIT], r = 4.5 / scale;
      ctx.fillStyle = data.lights[groups[step]];
      if (groups[step] === "stop") ctx.fillRect(x - r, y - r, 2 * r, 2 * r);
      else disc(ctx, x, y, r);
      ctx.strokeStyle = "#ffffff";
      ctx.lineWidth = 1 / scale;
      if (groups[step] === "stop") ctx.strokeRect(x - r, y - r, 2 * r, 2 * r);
      else ctx.stroke();
    }
  }

  function drawAgents(ctx, scene, poses, offroad, left, scale) {
    poses.forEach((pose, agent) => {
      if (!pose) return;
      const { color, halo } = data.classes[scene.class[agent]], box = corners(pose, scene.size[agent]);
      ctx.fillStyle = color;
      if (halo) { ctx.globalAlpha = 0.25; disc(ctx, pose[0], pose[1], 6 / scale); ctx.globalAlpha = 1; }
      outline(ctx, box);
      ctx.fill();
      if (left.has(agent)) hatch(ctx, box, pose, scene.size[agent], scale);
      outline(ctx, box);
      ctx.lineWidth = (left.has(agent) ? 2.5 : offroad.has(agent) ? 1.2 : 0.7) / scale;
      ctx.strokeStyle = offroad.has(agent) ? ROAD : "#ffffff";
      ctx.stroke();
      const mix = (a, b, t) => [a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])];
      outline(ctx, [mix(box[0], box[3], 0.5), mix(box[0], box[1], 0.33), mix(box[3], box[2], 0.33)]);
      ctx.fillStyle = "rgba(255, 255, 255, 0.6)";
      ctx.fill();
    });
  }

  function hatch(ctx, box, pose, size, scale) {
    const reach = Math.hypot(size[0], size[1]) * UNIT / 2, gap = Math.max(4.5 / scale, reach / 8);
    ctx.save();
    outline(ctx, box);
    ctx.clip();
    ctx.translate(pose[0], pose[1]);
    ctx.rotate(pose[2] + Math.PI / 4);
    ctx.strokeStyle = ROAD;
    ctx.lineWidth = gap * 0.5;
    ctx.beginPath();
    for (let x = -reach; x <= reach; x += gap) { ctx.moveTo(x, -reach); ctx.lineTo(x, reach); }
    ctx.stroke();
    ctx.restore();
  }

  // Rings lie over everything: a collision between two boxes of a few pixels must be seen.
  function drawRing(ctx, pose, size, scale, { color, room, width, dash }) {
    ctx.strokeStyle = color;
    ctx.lineWidth = width / scale;
    ctx.setLineDash(dash.map((length) => length / scale));
    circle(ctx, pose[0], pose[1], Math.hypot(size[0], size[1]) * UNIT / 2 + room / scale);
    ctx.stroke();
    ctx.setLineDash([]);
  }

  function drawOutlines(ctx, scene, poses, scale, dash) {
    ctx.strokeStyle = INK;
    ctx.lineWidth = 1.2 / scale;
    ctx.setLineDash(dash.map((length) => length / scale));
    poses.forEach((pose, agent) => { if (pose) { outline(ctx, corners(pose, scene.size[agent])); ctx.stroke(); } });
    ctx.setLineDash([]);
  }

  function drawScale(ctx, side, scale) {
    const length = [100, 50, 20, 10, 5, 2].find((metres) => metres * scale < side / 3) || 1, bar = length * scale, y = side - 14;
    ctx.strokeStyle = ctx.fillStyle = INK;
    ctx.lineWidth = 2;
    ctx.beginPath(); ctx.moveTo(14, y); ctx.lineTo(14 + bar, y); ctx.stroke();
    ctx.font = "12px system-ui, sans-serif";
    ctx.textAlign = "center";
    ctx.textBaseline = "alphabetic";
    ctx.fillText(length + " m", 14 + bar / 2, y - 6);
  }

  // A canvas as sharp as the screen; its context measures CSS pixels.
  function sharp(canvas) {
    const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight, ctx = canvas.getContext("2d");
    const [w, h] = [Math.round(width * ratio), Math.round(height * ratio)];
    if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    return { ctx, width, height, ratio };
  }

  function paint(canvas, scene, side, { ghosts, coupled }) {
    const { ctx, width, ratio } = sharp(canvas);
    if (!width) return;
    const [x, y, radius] = state.view, scale = width / (2 * radius), marks = $("marks").checked, step = Math.floor(state.time);
    ctx.fillStyle = data.ground;
    ctx.fillRect(0, 0, width, width);
    // The scene's y points up, the canvas' y points down.
    ctx.setTransform(ratio * scale, 0, 0, -ratio * scale, ratio * (width / 2 - x * scale), ratio * (width / 2 + y * scale));
    const poses = side.tracks.map((track) => poseAt(track, state.time));
    drawMap(ctx, scene, scale);
    if ($("paths").checked) drawPaths(ctx, scene, side.tracks, state.time, scale);
    if (ghosts) drawOutlines(ctx, scene, ghosts.map((track) => poseAt(track, state.time)), scale, []);
    const none = new Set();
    drawAgents(ctx, scene, poses, marks ? side.offroad[step] : none, marks ? side.left[step] : none, scale);
    drawLights(ctx, scene, state.time, scale);
    if (coupled) drawOutlines(ctx, scene, coupled, scale, [4, 3]);
    const ring = (agent, look) => { if (poses[agent]) drawRing(ctx, poses[agent], scene.size[agent], scale, look); };
    if (marks) side.collides[step].forEach((agent) => ring(agent, { color: RING, room: 3, width: 2.5, dash: [] }));
    const chosen = chosenAgent();
    if (chosen) ring(chosen.agent, { color: CHOSEN, room: 7, width: 1.8, dash: [5, 3] });
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    drawScale(ctx, width, scale);
  }

  // --- the bar of mishaps under the slider -----------------------------------------------------------------------

  const THUMB = 8;                    // a slider's ends lie half a thumb inside it [CSS pixels]

  function drawStrip(rollout) {
    const { ctx, width, height } = sharp($("strip")), room = Math.max(width - 2 * THUMB, 1), each = room / (data.steps - 1);
    ctx.clearRect(0, 0, width, height);
    const rows = [["collides", RING], ["left", ROAD]], tall = height / 2 - 2;
    rows.forEach(([name, color], row) => {
      const top = row * (height / 2) + 1, most = Math.max(1, ...rollout[name].map((set) => set.size));
      ctx.fillStyle = "rgba(120, 126, 133, 0.13)";
      ctx.fillRect(THUMB, top, room, tall);
      ctx.fillStyle = color;
      rollout[name].forEach((set, step) => {
        if (!set.size) return;
        const part = tall * (0.35 + 0.65 * set.size / most), left = THUMB + (step - 0.5) * each;
        ctx.fillRect(Math.max(left, THUMB), top + tall - part, Math.min(each + 0.3, THUMB + room - left), part);
      });
    });
    ctx.fillStyle = INK;
    ctx.fillRect(THUMB + data.now * each - 0.5, 0, 1, height);
    ctx.fillRect(THUMB + state.time * each - 1, 0, 2, height);
  }

  // --- the coupling ----------------------------------------------------------------------------------------------

  function chosenAgent() {
    if (state.method === null) return null;
    const agents = rolloutAt(sceneAt(state.scene), state.method, state.rollout).agents;
    return agents.find((entry) => entry.agent === state.agent) || agents[0] || null;
  }

  // The pair that the present moment of the rollout belongs to.
  function pairNow(entry) {
    const seconds = (state.time - data.now) * data.seconds;
    return entry.pairs.find((pair, i) => {
      const before = i ? entry.pairs[i - 1].rollout : 0;
      // Of a moment that the log leaves out there is none, although a later pair follows.
      return seconds > Math.max(before, pair.rollout - entry.step) + 1e-6 && seconds <= pair.rollout + 1e-6;
    }) || null;
  }

  // The same colours for all rollouts and methods of a scene, so that a cheaper one looks cheaper.
  function dearestPair(scene, agent) {
    if (!scene.dearest.has(agent)) {
      let most = 0;
      for (const method of methodsOf(scene)) {
        scene.rollouts[method].kept.forEach((_, index) => {
          const entry = rolloutAt(scene, method, index).agents.find((each) => each.agent === agent);
          if (entry) most = Math.max(most, ...entry.pairs.map((pair) => pair.cost));
        });
      }
      scene.dearest.set(agent, Math.max(most, 0.1));
    }
    return scene.dearest.get(agent);
  }

  function costColor(part) {
    const place = Math.min(Math.max(part, 0), 1) * (COSTS.length - 1), low = Math.min(Math.floor(place), COSTS.length - 2);
    return `rgb(${COSTS[low].map((value, k) => Math.round(value + (place - low) * (COSTS[low + 1][k] - value))).join(" ")})`;
  }

  // Every pair of steps that could be coupled: the darker the dearer. Steps that the log lacks are left sand-coloured.
  function drawCosts(ctx, entry, x, y, most) {
    const half = entry.step / 2, size = x(entry.step) - x(0), last = LAST + half;
    ctx.fillStyle = "#f4ead8";
    ctx.fillRect(x(half), y(last), x(last) - x(half), y(half) - y(last));
    entry.costs().forEach((row, i) => row.forEach((cost, k) => {
      const grey = Math.round(252 - 80 * Math.min(cost / most, 1));
      ctx.fillStyle = `rgb(${grey} ${grey} ${grey + 4})`;
      ctx.fillRect(x(entry.times[k] - half), y(entry.times[i] + half), size + 0.5, size + 0.5);
    }));
  }

  const tone = (name, fallback) => getComputedStyle($("matrix")).getPropertyValue(name).trim() || fallback;

  const LAST = (data.steps - 1 - data.now) * data.seconds;

  // Where the matrix lies on its canvas, and how much time each of its sides spans; a cell lies around its step.
  const matrixFrame = (width, step) => ({ left: 42, top: 30, side: Math.max(width - 82, 10), seconds: LAST + step / 2 });

  function drawMatrix(scene, entry) {
    const { ctx, width, height } = sharp($("matrix"));
    ctx.clearRect(0, 0, width, height);
    if (!entry || !width) return;
    const { left, top, side, seconds } = matrixFrame(width, entry.step), most = dearestPair(scene, entry.agent);
    const x = (time) => left + time / seconds * side, y = (time) => top + side - time / seconds * side;
    const ink = tone("--ink", INK), quiet = tone("--quiet", "#5f6368"), rule = tone("--rule", "#e3e5e8");
    ctx.font = "12px system-ui, sans-serif";
    ctx.lineWidth = 1;
    drawCosts(ctx, entry, x, y, most);
    for (let time = 0; time <= LAST + 1e-6; time += 2) {
      ctx.strokeStyle = rule;
      ctx.beginPath(); ctx.moveTo(x(time), y(0)); ctx.lineTo(x(time), y(seconds)); ctx.moveTo(x(0), y(time)); ctx.lineTo(x(seconds), y(time)); ctx.stroke();
      ctx.fillStyle = quiet;
      ctx.textAlign = "center"; ctx.textBaseline = "top";
      ctx.fillText(String(time), x(time), y(0) + 5);
      ctx.textAlign = "right"; ctx.textBaseline = "middle";
      ctx.fillText(String(time), x(0) - 6, y(time));
    }
    ctx.setLineDash([4, 4]);
    ctx.strokeStyle = quiet;
    ctx.beginPath(); ctx.moveTo(x(0), y(0)); ctx.lineTo(x(seconds), y(seconds)); ctx.stroke();
    ctx.setLineDash([]);
    ctx.fillStyle = ink;
    ctx.textAlign = "center"; ctx.textBaseline = "top";
    ctx.fillText("time in the log [s]", left + side / 2, y(0) + 21);
    ctx.save();
    ctx.translate(12, top + side / 2); ctx.rotate(-Math.PI / 2);
    ctx.fillText("time in the rollout [s]", 0, -6);
    ctx.restore();
    const now = Math.max(0, (state.time - data.now) * data.seconds), current = pairNow(entry);
    ctx.fillStyle = "rgba(42, 120, 181, 0.18)";
    ctx.fillRect(x(0), y(now) - 2, side, 4);
    if (current) {
      ctx.strokeStyle = tone("--accent", "#2a78b5");
      ctx.setLineDash([3, 3]);
      ctx.beginPath(); ctx.moveTo(x(current.log), y(current.rollout)); ctx.lineTo(x(current.log), y(0)); ctx.stroke();
      ctx.setLineDash([]);
    }
    const radius = Math.min(Math.max(side / seconds * entry.step * 0.32, 3), 9);
    for (const pair of entry.pairs) {
      ctx.fillStyle = costColor(pair.cost / most);
      disc(ctx, x(pair.log), y(pair.rollout), radius);
      ctx.strokeStyle = pair === current ? ink : "#ffffff";
      ctx.lineWidth = pair === current ? 2.5 : 1;
      ctx.stroke();
    }
    const wide = 110, right = left + side, ramp = ctx.createLinearGradient(right - wide, 0, right, 0);
    for (const part of [0, 0.25, 0.5, 0.75, 1]) ramp.addColorStop(part, costColor(part));
    ctx.fillStyle = ramp;
    ctx.fillRect(right - wide, 8, wide, 8);
    ctx.fillStyle = quiet;
    ctx.textBaseline = "middle"; ctx.textAlign = "right";
    ctx.fillText("cost of a pair  0", right - wide - 6, 12);
    ctx.textAlign = "left";
    ctx.fillText(most.toFixed(1), right + 5, 12);
  }

  const GAP = "\u00a0";                // between a number and its unit, where no line may break
  const percent = (part) => part > 0 && part < 0.01 ? `under 1${GAP}%` : `${Math.round(100 * part)}${GAP}%`;
  const plural = (count, name) => `${count} ${name}${count === 1 ? "" : "s"}`;
  const signed = (seconds) => (seconds < -0.05 ? "−" : "+") + Math.abs(seconds).toFixed(1) + GAP + "s";

  function sentenceOf(scene, entry) {
    const name = scene.agents[entry.agent].replace(/^./, (letter) => letter.toUpperCase()), pairs = entry.pairs, steps = plural(pairs.length, "step");
    if (!entry.paid) return `${name} pays nothing: this rollout drives it as the log does.`;
    if (!pairs.length) return `${name} pays ${percent(entry.part)} of what all agents pay (${entry.paid.toFixed(1)}); its log is too short to show here what it is coupled with.`;
    const [feature, share] = entry.shares.reduce((a, b) => b[1] > a[1] ? b : a);
    const pays = `${name} pays ${percent(entry.part)} of what all agents pay (${entry.paid.toFixed(1)}), most of it for ${feature} (${share}${GAP}%).`;
    const away = pairs.filter((pair) => Math.abs(pair.log - pair.rollout) > NEAR + 1e-6);
    if (!away.length) return `${pays} All ${steps} lie on the diagonal: they are coupled with the same moment of the log, give or take ${NEAR}${GAP}s.`;
    const mean = away.reduce((sum, pair) => sum + Math.abs(pair.log - pair.rollout), 0) / away.length;
    const how = away.length === pairs.length ? `None of the ${steps} is` : `${pairs.length - away.length} of ${steps} are`;
    const late = away.filter((pair) => pair.log < pair.rollout).length / away.length;
    const when = late > 0.65 ? " earlier in the log: the rollout is late" : late < 0.35 ? " later in the log: the rollout is ahead of it" : " away";
    return `${pays} ${how} coupled with the same moment of the log, give or take ${NEAR}${GAP}s; the others find what is like them ${mean.toFixed(1)}${GAP}s${when}.`;
  }

  function momentOf(entry) {
    const pair = pairNow(entry);
    if (!pair) return state.time <= data.now + 1e-6 ? "Until 0 s the rollout is the log." : "At this moment the log has no valid step, so nothing is coupled.";
    const { features } = sceneAt(state.scene).rollouts[state.method];
    const apart = features.map(({ weight }, k) => weight * (pair.values[0][k] - pair.values[1][k]) ** 2), most = apart.indexOf(Math.max(...apart));
    const [mine, theirs] = pair.values.map((values) => values[most].toFixed(1).replace("-", "−")), unit = features[most].unit === "1" ? "" : GAP + features[most].unit;
    const why = pair.cost < 0.05 ? "" : ` The most of it is ${features[most].name}: ${mine}${unit} in the rollout, ${theirs}${unit} in the log.`;
    return `At ${signed(pair.rollout)} the rollout is coupled with ${signed(pair.log)} of the log, at a cost of ${pair.cost.toFixed(1)}.${why}`;
  }

  function showParts(entry) {
    const cells = [];
    for (const [name, share] of [...entry.shares].sort((a, b) => b[1] - a[1])) {
      const [label, bar, value] = ["span", "span", "span"].map((tag) => document.createElement(tag)), fill = document.createElement("i");
      label.textContent = name;
      fill.style.width = share + "%";
      bar.append(fill);
      value.textContent = share + GAP + "%";
      cells.push(label, bar, value);
    }
    $("parts").replaceChildren(...cells);
    $("parts").setAttribute("aria-label", "Shares of the features: " + entry.shares.map(([name, share]) => `${name} ${share} %`).join(", "));
  }

  // --- everything ------------------------------------------------------------------------------------------------

  function note(element, name, side, rest) {
    const step = Math.floor(state.time), bold = document.createElement("b");
    bold.textContent = name;
    const left = side.left[step].size, outside = side.offroad[step].size - left;
    const beside = outside ? `, ${outside} ${outside === 1 ? "is" : "are"} off it from the start` : "";
    element.replaceChildren(bold, `${rest} · ${side.collides[step].size} in collision, ${left} left the road${beside}`);
  }

  function draw() {
    const scene = sceneAt(state.scene), none = state.method === null, entry = chosenAgent();
    const rollout = none ? scene.log : rolloutAt(scene, state.method, state.rollout), pair = entry && pairNow(entry);
    const coupled = pair && scene.log.tracks.map((track, agent) => agent === entry.agent ? poseAt(track, data.now + pair.log / data.seconds) : null);
    paint($("log"), scene, scene.log, { ghosts: null, coupled });
    paint($("roll"), scene, rollout, { ghosts: $("ghost").checked ? scene.log.tracks : null, coupled: null });
    note($("log-name"), "log", scene.log, "");
    if (none) note($("roll-name"), "no rollout", rollout, "");
    else note($("roll-name"), state.method, rollout, " · " + describe(scene.rollouts[state.method], state.rollout));
    drawStrip(rollout);
    drawMatrix(scene, entry);
    $("moment").textContent = entry ? momentOf(entry) : "";
    const seconds = signed((state.time - data.now) * data.seconds);
    $("clock").textContent = seconds;
    $("time").value = state.time;
    $("time").setAttribute("aria-valuetext", seconds);
    $("play").textContent = state.playing ? "pause" : "play";
  }

  let queued = false;
  function refresh() {
    if (!queued) { queued = true; requestAnimationFrame((clock) => { queued = false; tick(clock); draw(); }); }
  }

  function tick(clock) {
    if (!state.playing) { state.last = null; return; }
    // Pages that are out of sight get no frames: what time has passed there is not played.
    if (state.last !== null) state.time += Math.min(clock - state.last, 100) / 1000 / data.seconds * Number($("speed").value);
    state.last = clock;
    if (state.time >= data.steps - 1) { state.time = data.steps - 1; state.playing = false; state.last = null; }
    else refresh();
  }

  // --- what the reader does --------------------------------------------------------------------------------------

  function fill(select, entries, chosen) {
    select.replaceChildren(...entries.map(([value, name]) => new Option(name, String(value), false, value === chosen)));
    select.value = String(chosen);
  }

  const ending = (number) => ["th", "st", "nd", "rd"][number % 100 > 10 && number % 100 < 14 ? 0 : number % 10] || "th";
  const nats = (value) => value.toPrecision(3).replace("-", "−") + " nats per token";

  function describe(given, index) {
    const kept = given.kept[index], place = 1 + kept[$("sort").value];
    return `${place}${ending(place)} of ${given.sampled} · distance ${kept.distance.toFixed(1)} · ${nats(kept.nats)}`;
  }

  const likeliest = (given) => given.kept.findIndex((kept) => kept.likelier === 0);
  const inOrder = (given) => given.kept.map((_, index) => index).sort((a, b) => given.kept[a][$("sort").value] - given.kept[b][$("sort").value]);

  function chooseScene(index) {
    const scene = sceneAt(index), methods = methodsOf(scene);
    state.scene = index;
    state.agent = null;
    state.view = [...scene.fit];
    fill($("method"), methods.map((name, i) => [i, name]), Math.max(0, methods.indexOf(state.method)));
    $("why").hidden = !methods.length;
    $("likely").disabled = !methods.length;
    if (methods.length) chooseMethod(methods[Number($("method").value)], false);
    else { state.method = null; fill($("rollout"), [], null); fill($("agent"), [], null); refresh(); }
  }

  // Another method shows its rollout of the same kind: the most likely one, or the same place in the order.
  function chooseMethod(method, alike) {
    const scene = sceneAt(state.scene), before = alike ? scene.rollouts[state.method] : null, given = scene.rollouts[method];
    const likely = !before || likeliest(before) === state.rollout, place = before ? inOrder(before).indexOf(state.rollout) : 0;
    state.method = method;
    listRollouts();
    chooseRollout(likely ? likeliest(given) : inOrder(given)[Math.min(place, given.kept.length - 1)]);
  }

  function listRollouts() {
    const given = sceneAt(state.scene).rollouts[state.method];
    fill($("rollout"), inOrder(given).map((index) => [index, describe(given, index) + (likeliest(given) === index ? " · most likely" : "")]), state.rollout);
  }

  function chooseRollout(index) {
    state.rollout = index;
    $("rollout").value = String(index);
    const scene = sceneAt(state.scene), agents = rolloutAt(scene, state.method, index).agents;
    fill($("agent"), agents.map((entry) => [entry.agent, `${scene.agents[entry.agent]} · ${percent(entry.part)} of the distance`]), null);
    showAgent();
  }

  function chooseAgent(agent) {
    state.agent = agent;
    showAgent();
  }

  function showAgent() {
    const scene = sceneAt(state.scene), entry = chosenAgent();
    if (entry) { $("agent").value = String(entry.agent); showParts(entry); }
    $("sentence").textContent = entry ? sentenceOf(scene, entry) : "No agent of this scene was ranked.";
    refresh();
  }

  function play() {
    if (!state.playing && state.time >= data.steps - 1) state.time = data.now;
    state.playing = !state.playing;
    refresh();
  }

  function seek(time) {
    state.playing = false;
    state.time = Math.min(Math.max(time, 0), data.steps - 1);
    refresh();
  }

  // The point of the picture at `at` (CSS pixels of a square of `side`) stays where it is.
  function zoom(factor, at, side) {
    const [x, y, radius] = state.view, wider = Math.min(Math.max(radius * factor, 5), 500), shift = (radius - wider) / (side / 2);
    state.view = [x + (at[0] - side / 2) * shift, y - (at[1] - side / 2) * shift, wider];
    refresh();
  }

  function pick(canvas, side, at) {
    const scene = sceneAt(state.scene), scale = canvas.clientWidth / (2 * state.view[2]), ranked = state.method === null ? [] : rolloutAt(scene, state.method, state.rollout).agents;
    const away = ranked.map(({ agent }) => {
      const pose = poseAt(side.tracks[agent], state.time);
      if (!pose) return [Infinity, agent];
      const half = canvas.clientWidth / 2, dx = half + (pose[0] - state.view[0]) * scale - at[0], dy = half - (pose[1] - state.view[1]) * scale - at[1];
      return [Math.hypot(dx, dy) - Math.hypot(...scene.size[agent]) * UNIT / 2 * scale, agent];
    }).sort((a, b) => a[0] - b[0]);
    if (away.length && away[0][0] < 12) chooseAgent(away[0][1]);
  }

  function handle(canvas, sideOf) {
    const touching = new Map();       // pointers that are down, by id
    let moved = 0;
    canvas.addEventListener("wheel", (event) => {
      // Elsewhere the wheel scrolls the page; a picture must not catch a reader who only passes over it.
      if (document.activeElement !== canvas && !event.ctrlKey) return;
      event.preventDefault();
      zoom(Math.exp(event.deltaY * 0.0015), [event.offsetX, event.offsetY], canvas.clientWidth);
    }, { passive: false });
    canvas.addEventListener("pointerdown", (event) => {
      if (!touching.size) moved = 0;
      touching.set(event.pointerId, [event.offsetX, event.offsetY]);
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = touching.get(event.pointerId);
      if (!before) return;
      const here = [event.offsetX, event.offsetY], metres = 2 * state.view[2] / canvas.clientWidth / touching.size;
      const spread = () => { const [a, b] = [...touching.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]); };
      const wide = touching.size === 2 ? spread() : 0;
      touching.set(event.pointerId, here);
      moved += Math.hypot(here[0] - before[0], here[1] - before[1]);
      if (moved < 5) return;
      state.view[0] -= (here[0] - before[0]) * metres;
      state.view[1] += (here[1] - before[1]) * metres;
      if (wide) {
        const [a, b] = [...touching.values()];
        zoom(wide / Math.max(spread(), 1), [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2], canvas.clientWidth);
      }
      refresh();
    });
    canvas.addEventListener("pointerup", (event) => {
      if (touching.delete(event.pointerId) && moved < 5) pick(canvas, sideOf(), [event.offsetX, event.offsetY]);
    });
    canvas.addEventListener("pointercancel", (event) => touching.delete(event.pointerId));
  }

  function inView() {
    const { top, bottom } = $("roll").getBoundingClientRect();
    return bottom > 0 && top < window.innerHeight;
  }

  function showLegend() {
    const used = new Set(data.scenes.flatMap((scene) => scene.class)), entries = [];
    data.classes.forEach(({ name, color }, i) => { if (used.has(i)) entries.push([name, color, ""]); });
    if (data.scenes.some((scene) => scene.lights.length)) {
      for (const [name, color] of Object.entries(data.lights)) entries.push(["light: " + name, color, ""]);
    }
    entries.push(["in collision", "", "ring"], ["left the road", "", "road"], ["off it from the start", "", "beside"], ["chosen agent, and in the log where it is coupled", "", "chosen"]);
    for (const [name, color, look] of entries) {
      const item = document.createElement("span"), swatch = document.createElement("i");
      if (look) swatch.className = look; else swatch.style.background = color;
      item.append(swatch, name);
      $("legend").append(item);
    }
  }

  $("scene").addEventListener("change", (event) => chooseScene(Number(event.target.value)));
  $("method").addEventListener("change", (event) => chooseMethod(methodsOf(sceneAt(state.scene))[Number(event.target.value)], true));
  $("sort").addEventListener("change", () => { if (state.method !== null) { listRollouts(); refresh(); } });
  $("rollout").addEventListener("change", (event) => chooseRollout(Number(event.target.value)));
  $("likely").addEventListener("click", () => chooseRollout(likeliest(sceneAt(state.scene).rollouts[state.method])));
  $("agent").addEventListener("change", (event) => chooseAgent(Number(event.target.value)));
  $("time").addEventListener("input", (event) => seek(Number(event.target.value)));
  $("strip").addEventListener("click", (event) => seek((event.offsetX - THUMB) / (event.target.clientWidth - 2 * THUMB) * (data.steps - 1)));
  $("matrix").addEventListener("click", (event) => {
    const entry = chosenAgent();
    if (!entry) return;
    const { top, side, seconds } = matrixFrame(event.target.clientWidth, entry.step), time = (top + side - event.offsetY) / side * seconds;
    if (time >= 0 && time <= seconds) seek(data.now + Math.round(time / data.seconds));
  });
  $("play").addEventListener("click", play);
  $("fit").addEventListener("click", () => { state.view = [...sceneAt(state.scene).fit]; refresh(); });
  for (const [name, factor] of [["in", 1 / 1.4], ["out", 1.4]]) $(name).addEventListener("click", () => zoom(factor, [1, 1], 2));
  for (const name of ["paths", "ghost", "marks"]) $(name).addEventListener("change", refresh);
  handle($("log"), () => sceneAt(state.scene).log);
  handle($("roll"), () => state.method === null ? sceneAt(state.scene).log : rolloutAt(sceneAt(state.scene), state.method, state.rollout));
  new ResizeObserver(refresh).observe($("log"));     // also when the player is shown that was hidden, or the page is zoomed
  document.addEventListener("keydown", (event) => {
    // Lists, buttons and fields have a use of their own for these keys, and so has a page of which the player is a part.
    if (["SELECT", "BUTTON", "INPUT", "TEXTAREA", "SUMMARY", "A"].includes(event.target.tagName) || !inView()) return;
    if (event.key === " ") { event.preventDefault(); play(); }
    if (event.key === "ArrowRight") seek(Math.floor(state.time + 1e-6) + 1);
    if (event.key === "ArrowLeft") seek(Math.ceil(state.time - 1e-6) - 1);
  });
  $("time").max = data.steps - 1;
  fill($("scene"), data.scenes.map((scene, i) => [i, scene.id]), 0);
  showLegend();
  chooseScene(0);
})();
