"use strict";
// 3D view of the scene: points with the observers' gaze, participants' paths, AOI boxes, and observer marks.
// Drag rotates, Shift-drag or the right button pans, the wheel zooms. The view is drawn only after a change. Without
// WebGL the fallback image stays visible.
(function () {
  const stage = document.getElementById("stage");
  const about = JSON.parse(document.getElementById("stage-data").textContent);
  const canvas = stage.querySelector("canvas");
  const gl = canvas.getContext("webgl", { antialias: true, preserveDrawingBuffer: true });
  if (!gl) return;

  const bytes = Uint8Array.from(atob(about.data), (c) => c.charCodeAt(0));
  const part = (name) => bytes.subarray(about.parts[name][0], about.parts[name][0] + about.parts[name][1]);

  function program(vertex, fragment) {
    const made = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
    return made;
  }

  function buffer(data) {
    const made = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, made);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    return made;
  }

  const points = program(
    `attribute vec3 place, normal, color; attribute float gaze;
     uniform mat4 view; uniform vec3 lower, size, eye; uniform float scale; varying vec3 shown;
     varying float heat; varying float back;
     void main() {
       vec3 p = lower + place * size;
       vec3 n = normal * 2.0 - 1.0;
       vec3 away = eye - p;
       back = dot(n, away) < 0.0 ? 1.0 : 0.0;
       gl_Position = view * vec4(p, 1.0);
       gl_PointSize = clamp(scale / gl_Position.w, 1.0, 24.0);
       shown = color; heat = gaze * gaze;
     }`,
    `precision mediump float; uniform sampler2D map; uniform float strength; varying vec3 shown;
     varying float heat; varying float back;
     void main() {
       if (back > 0.5) discard;
       float grey = dot(shown, vec3(0.2126, 0.7152, 0.0722));
       float x = clamp(heat / 0.35, 0.0, 1.0);
       float alpha = strength * 0.9 * x * x * (3.0 - 2.0 * x);
       vec3 base = mix(shown, 0.8 * mix(shown, vec3(grey), 0.6), strength);
       gl_FragColor = vec4(mix(base, texture2D(map, vec2(heat, 0.5)).rgb, alpha), 1.0);
     }`
  );
  const lines = program(
    `attribute vec3 place; uniform mat4 view; uniform vec3 lower, size; uniform float dot;
     void main() { gl_Position = view * vec4(lower + place * size, 1.0); gl_PointSize = dot; }`,
    `precision mediump float; uniform vec4 color; uniform float round;
     void main() {
       float r = length(gl_PointCoord - 0.5);
       if (round > 0.5 && r > 0.5) discard;
       gl_FragColor = round > 0.5 && r > 0.34 ? vec4(1.0) : color;
     }`
  );

  const cloud = { place: buffer(part("place")), normal: buffer(part("normal")), color: buffer(part("color")) };
  const gaze = about.observers.map((_, k) => buffer(part("gaze").subarray(k * about.count, (k + 1) * about.count)));
  const paths = buffer(part("paths")), boxes = buffer(part("boxes")), marks = buffer(part("marks"));
  const map = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, map);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, 256, 1, 0, gl.RGB, gl.UNSIGNED_BYTE, part("map"));
  for (const [key, value] of [[gl.TEXTURE_MIN_FILTER, gl.LINEAR], [gl.TEXTURE_MAG_FILTER, gl.LINEAR],
    [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE]])
    gl.texParameteri(gl.TEXTURE_2D, key, value);

  // The camera orbits a point; `up` is the up axis of the scene, the other two axes are horizontal.
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const plus = (a, b, s) => a.map((v, k) => v + s * b[k]);
  const unit = (a) => a.map((v) => v / Math.hypot(...a));
  const up = about.up;
  const east = unit(cross(Math.abs(up[1]) < 0.9 ? [0, 1, 0] : [1, 0, 0], up));
  const north = cross(up, east);
  const start = () => ({ turn: about.camera.turn, rise: about.camera.rise, away: about.camera.away,
    target: about.camera.target.slice() });
  let at = start();

  function camera() {
    const level = plus(east.map((v) => v * Math.cos(at.turn)), north, Math.sin(at.turn));
    const back = plus(level.map((v) => v * Math.cos(at.rise)), up, Math.sin(at.rise));
    const right = unit(cross(up, back));
    return { eye: plus(at.target, back, at.away), right, above: cross(back, right), back };
  }

  function matrix(from, width, height) {
    const near = at.away * 0.01, far = at.away * 4 + about.reach * 4, f = 1 / Math.tan(0.45);
    const rows = [from.right, from.above, from.back].map((axis) => [...axis, -dot(axis, from.eye)]);
    const side = Math.max(width, height), x = f * side / width, y = f * side / height;
    const a = (far + near) / (near - far), b = 2 * far * near / (near - far);
    const out = new Float32Array(16);
    for (let k = 0; k < 4; k++) {
      out[4 * k] = x * rows[0][k];
      out[4 * k + 1] = y * rows[1][k];
      out[4 * k + 2] = a * rows[2][k] + (k === 3 ? b : 0);
      out[4 * k + 3] = -rows[2][k];
    }
    return out;
  }

  const choice = stage.querySelector("select");
  const shown = (name) => stage.querySelector(`input[name=${name}]`);
  const set = (of, name, data) => gl[`uniform${data.length === 16 ? "Matrix4fv" : data.length + "fv"}`](
    ...(data.length === 16 ? [gl.getUniformLocation(of, name), false, data] : [gl.getUniformLocation(of, name), data]));

  function attribute(of, name, data, size, type) {
    const where = gl.getAttribLocation(of, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, data);
    gl.enableVertexAttribArray(where);
    gl.vertexAttribPointer(where, size, type, true, 0, 0);
  }

  function draw() {
    waiting = false;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
    if (!width || !height) return;
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    gl.viewport(0, 0, width, height);
    gl.clearColor(0.96, 0.96, 0.95, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    const from = camera(), view = matrix(from, width, height), number = Number(choice.value);

    gl.useProgram(points);
    set(points, "view", view); set(points, "lower", about.lower); set(points, "size", about.size);
    set(points, "eye", from.eye); set(points, "strength", [shown("gaze").checked ? 1 : 0]);
    set(points, "scale", [1.7 * about.spacing * Math.max(width, height) / (2 * Math.tan(0.45))]);
    attribute(points, "place", cloud.place, 3, gl.UNSIGNED_SHORT);
    attribute(points, "normal", cloud.normal, 3, gl.UNSIGNED_BYTE);
    attribute(points, "color", cloud.color, 3, gl.UNSIGNED_BYTE);
    attribute(points, "gaze", gaze[number], 1, gl.UNSIGNED_BYTE);
    gl.drawArrays(gl.POINTS, 0, about.count);
    for (let k = 0; k < 4; k++) gl.disableVertexAttribArray(k);

    gl.useProgram(lines);
    set(lines, "view", view); set(lines, "lower", about.lower); set(lines, "size", about.size); set(lines, "round", [0]);
    const strip = (data, color, mode, first, count) => {
      attribute(lines, "place", data, 3, gl.UNSIGNED_SHORT);
      set(lines, "color", color);
      gl.drawArrays(mode, first, count);
    };
    if (shown("boxes")?.checked) strip(boxes, [0.1, 0.35, 0.75, 1], gl.LINES, 0, part("boxes").length / 6);
    if (shown("paths")?.checked)
      for (const [first, count] of about.paths) strip(paths, [0.05, 0.55, 0.45, 1], gl.LINE_STRIP, first, count);
    gl.disable(gl.DEPTH_TEST);
    set(lines, "round", [1]); set(lines, "dot", [13 * ratio]);
    for (let k = 0; k < about.marks; k++)
      if (about.observers[number].marks.includes(k)) strip(marks, [0.21, 0.76, 1, 1], gl.POINTS, k, 1);
    const top = about.observers[number].top;
    stage.querySelector("output").textContent = top ? `brightest from ${top} 1/sr on` : "no gaze";
    canvas.dataset.drawn = "true";
  }

  let waiting = false;
  const redraw = () => { if (!waiting) { waiting = true; requestAnimationFrame(draw); } };
  const held = new Map();
  let apart = 0;
  canvas.addEventListener("pointerdown", (e) => { canvas.setPointerCapture(e.pointerId); held.set(e.pointerId, e); apart = 0; });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (e) => { held.delete(e.pointerId); apart = 0; });
  canvas.addEventListener("pointermove", (e) => {
    const before = held.get(e.pointerId);
    if (!before) return;
    const x = e.clientX - before.clientX, y = e.clientY - before.clientY;
    held.set(e.pointerId, e);
    if (held.size === 2) {
      const [a, b] = [...held.values()], now = Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
      if (apart) closer(apart / now);
      apart = now;
    } else if (e.shiftKey || e.buttons === 2) {
      const c = camera(), step = at.away / canvas.clientHeight;
      at.target = plus(plus(at.target, c.right, -x * step), c.above, y * step);
    } else {
      at.turn -= x * 0.006;
      at.rise = Math.max(-1.5, Math.min(1.5, at.rise + y * 0.006));
    }
    redraw();
  });
  const closer = (by) => { at.away = Math.max(0.02 * about.reach, Math.min(6 * about.reach, at.away * by)); redraw(); };
  canvas.addEventListener("wheel", (e) => { e.preventDefault(); closer(Math.exp(e.deltaY * 0.001)); }, { passive: false });
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  stage.querySelector("button").addEventListener("click", () => { at = start(); redraw(); });
  for (const input of stage.querySelectorAll("input, select")) input.addEventListener("input", redraw);
  window.addEventListener("resize", redraw);
  stage.classList.add("live");
  draw();
})();
