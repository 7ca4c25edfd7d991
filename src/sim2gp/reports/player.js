// The player of a recorded run: it moves the shapes of the still picture.
// Same scene and same projection as scenes.py; drag to look from elsewhere.
"use strict";
document.querySelectorAll(".player").forEach(function (player) {
  const film = JSON.parse(player.querySelector("script").textContent);
  const bodies = player.querySelector(".bodies");
  const stage = player.querySelector("svg.stage");
  const shapes = Array.from(bodies.children).map(function (node) {
    return { node: node, spec: film.shapes[+node.dataset.i] };
  });
  const button = player.querySelector("button.play");
  const pace = player.querySelector("button.pace");
  const scrub = player.querySelector("input");
  const said = player.querySelector(".said");
  const clock = player.querySelector("output");
  const cursors = Array.from(player.querySelectorAll(".cursor"));
  const last = film.moving.length - 1;
  const paces = [1, 0.5, 0.25];
  const camera = Object.assign({}, film.camera);
  const canvas = player.querySelector("canvas.stage");
  const look = player.querySelector("button.look");
  let frames = [], modelled = false;
  let at = 0, playing = false, before = null, speed = 1;

  function lens() {
    const sa = Math.sin(camera.azimuth), ca = Math.cos(camera.azimuth);
    const se = Math.sin(camera.elevation), ce = Math.cos(camera.elevation);
    return function (p) {
      const x = p[0] - camera.target[0], y = p[1] - camera.target[1], z = p[2] - camera.target[2];
      const depth = camera.distance - (ce * ca * x + ce * sa * y + se * z);
      const k = camera.focal / depth;
      return [film.width / 2 + k * (-sa * x + ca * y),
        film.height / 2 - k * (-se * ca * x - se * sa * y + ce * z), depth, k];
    };
  }
  function text(points) {
    return points.map(function (p) { return p[0].toFixed(1) + "," + p[1].toFixed(1); }).join(" ");
  }
  function moving(frame) {  // points between two frames, in metres
    const i = Math.floor(frame), a = film.moving[i], b = film.moving[Math.min(i + 1, last)];
    const f = film.starts.includes(i + 1) ? 0 : frame - i;
    const points = [];
    for (let j = 0; j < a.length; j += 3) {
      points.push([0, 1, 2].map(function (d) { return (a[j + d] + f * (b[j + d] - a[j + d])) * film.grain; }));
    }
    return points;
  }
  function trail(spec, see) {
    const j = spec.points[0] - film.fixed.length, now = Math.floor(at);
    const start = Math.max(0, now - film.trail, ...film.starts.filter(function (s) { return s <= now; }));
    const points = [];
    for (let i = start; i <= now; i++) {
      points.push(see(film.moving[i].slice(3 * j, 3 * j + 3).map(function (v) { return v * film.grain; })));
    }
    points.push(see(moving(at)[j]));
    return points;
  }
  function paint() {  // the frame that MuJoCo rendered for this time
    const i = Math.min(frames.length - 1, Math.floor(at * film.dt / film.apart + 1e-6));
    const pen = canvas.getContext("2d");
    pen.clearRect(0, 0, canvas.width, canvas.height);
    pen.drawImage(frames[i], 0, 0);
    pen.font = canvas.width > 2 * canvas.clientWidth ? "24px sans-serif" : "15px sans-serif";
    pen.fillStyle = getComputedStyle(said).fill;
    pen.strokeStyle = getComputedStyle(document.body).backgroundColor;
    pen.lineWidth = 3;
    pen.strokeText(said.textContent, 12, 26);
    pen.fillText(said.textContent, 12, 26);
  }
  function draw() {
    const see = lens();
    const points = film.fixed.concat(moving(at)).map(see);
    shapes.forEach(function (shape) {
      const spec = shape.spec, node = shape.node;
      const seen = spec.kind === "trail" ? trail(spec, see) : spec.points.map(function (i) { return points[i]; });
      shape.depth = points[spec.anchor][2];
      if (spec.kind === "ball") {
        node.setAttribute("cx", seen[0][0].toFixed(1));
        node.setAttribute("cy", seen[0][1].toFixed(1));
        node.setAttribute("r", (spec.size * seen[0][3]).toFixed(1));
        return;
      }
      node.setAttribute("points", text(seen));
      if (spec.kind === "rod") {
        const k = seen.reduce(function (sum, p) { return sum + p[3]; }, 0) / seen.length;
        node.setAttribute("stroke-width", (spec.size * k).toFixed(1));
      }
      if (spec.cull) {
        const a = seen[0], b = seen[1], c = seen[2];
        const front = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) < 0;
        node.style.display = front ? "" : "none";
      }
    });
    const order = shapes.slice().sort(function (a, b) {
      return a.spec.layer - b.spec.layer || b.depth - a.depth || a.node.dataset.i - b.node.dataset.i;
    });
    if (order.some(function (shape, i) { return bodies.children[i] !== shape.node; })) {
      order.forEach(function (shape) { bodies.appendChild(shape.node); });
    }
    const time = at * film.dt;
    clock.textContent = time.toFixed(2) + " s";
    scrub.value = at;
    let words = "";
    film.marks.forEach(function (mark) { if (mark[0] <= time + 1e-6) words = mark[1]; });
    said.textContent = words;
    cursors.forEach(function (line) {
      const x = (last ? at / last : 0) * line.dataset.width;
      line.setAttribute("x1", x);
      line.setAttribute("x2", x);
    });
    if (modelled) paint();
  }
  function show(model) {
    modelled = model;
    canvas.hidden = !model;
    stage.style.display = model ? "none" : "";
    look.textContent = model ? "Lines" : "Model";
    draw();
  }
  function tick(now) {
    if (!playing) return;
    if (before !== null) at += (now - before) / 1000 * speed / film.dt;
    before = now;
    if (at >= last) { at = last; play(false); }
    draw();
    if (playing) requestAnimationFrame(tick);
  }
  function play(on) {
    playing = on;
    button.textContent = on ? "Pause" : "Play";
    if (!on) return;
    if (at >= last) at = 0;
    before = null;
    requestAnimationFrame(tick);
  }

  player.querySelector(".controls").hidden = false;
  scrub.max = last;
  button.addEventListener("click", function () { play(!playing); });
  pace.addEventListener("click", function () {
    speed = paces[(paces.indexOf(speed) + 1) % paces.length];
    pace.textContent = { 1: "1×", 0.5: "½×", 0.25: "¼×" }[speed];
  });
  scrub.addEventListener("input", function () { play(false); at = +scrub.value; draw(); });
  let held = null;
  if (film.camera.turns) {
    stage.classList.add("turn");
    stage.addEventListener("pointerdown", function (e) { held = [e.clientX, e.clientY]; stage.setPointerCapture(e.pointerId); });
    stage.addEventListener("pointerup", function () { held = null; });
    stage.addEventListener("pointercancel", function () { held = null; });
    stage.addEventListener("pointermove", function (e) {
      if (!held) return;
      camera.azimuth -= (e.clientX - held[0]) * 0.008;
      camera.elevation = Math.min(1.3, Math.max(0, camera.elevation + (e.clientY - held[1]) * 0.006));
      held = [e.clientX, e.clientY];
      draw();
    });
  }
  draw();
  if (canvas && film.frames) {
    // Decoded when they are drawn: all of them at once are much for a phone.
    Promise.all(film.frames.map(function (code) {
      return new Promise(function (done, failed) {
        const image = new Image();
        image.onload = function () { done(image); };
        image.onerror = failed;
        image.src = "data:image/webp;base64," + code;
      });
    })).then(function (all) {
      frames = all;
      look.hidden = false;
      look.addEventListener("click", function () { show(!modelled); });
      show(true);
    }, function () { /* a browser without WebP shows the figure */ });
  }
  if (window.matchMedia("(prefers-reduced-motion: no-preference)").matches && "IntersectionObserver" in window) {
    const watch = new IntersectionObserver(function (seen) {
      if (seen.some(function (entry) { return entry.isIntersecting; })) { watch.disconnect(); play(true); }
    }, { threshold: 0.9 });
    watch.observe(player.querySelector(".controls"));
  }
});
