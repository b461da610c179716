// The live page: shows what the server's ants do, and tells it what the visitor wants. Follows scene.js in the page.

const TRACE = 1800; // points of the way behind an ant
const PACES = [0.25, 0.5, 1, 2, 4];
const KEYS = { arrowright: 0, arrowup: 1, arrowleft: 2, arrowdown: 3, e: 0, n: 1, w: 2, s: 3 };
const ELSEWHERE = 4001; // the server's code for it
const byId = (id) => document.getElementById(id);

// By which the server finds this window's visit again after the page is loaded anew.
function visitToken() {
  try {
    return (sessionStorage.visit ||= crypto.randomUUID?.() ?? String(Math.random()).slice(2));
  } catch {
    return ""; // no storage here: every connection is a visit of its own
  }
}

class Live extends Stage {
  constructor(world) {
    super(world);
    this.world = world;
    this.state = {};
    this.map = new FloorMap(byId("map"), this.hex);
    this.curve = [];
    this.frames = 0;
    this.buildLegend(new Set([0, 1, 2, 3]));
    this.buildChoices();
    this.buildButtons();
    this.open();
    this.connect();
    setInterval(() => this.countFrames(), 1000);
  }

  // ------------------------------------------------ what the visitor does

  buildChoices() {
    const fill = (id, entries) => entries.forEach(([value, text]) => (element("option", "", byId(id), text).value = value));
    fill("first", this.world.sub_policies.map((row) => [row, row.replace("walker/", "")]));
    fill("second", [["", "no others beside them"], ...this.world.sub_policies.map((row) => [row, `beside them: ${row.replace("walker/", "")}`])]);
    fill("arena", [...this.world.arenas.map((name) => [name, name]), ["drawn", "my own"]]);
    byId("arena").lastChild.hidden = byId("arena").lastChild.disabled = true; // shown, not to be chosen
    fill("pace", PACES.map((pace) => [pace, `${pace} ×`]));
    byId("pace").value = 1;
    const rows = () => this.send({ do: "sub_policies", rows: [byId("first").value, byId("second").value].filter(Boolean) });
    byId("first").addEventListener("change", rows);
    byId("second").addEventListener("change", rows);
    byId("arena").addEventListener("change", (event) => this.send({ do: "arena", name: event.target.value }));
    byId("pace").addEventListener("change", (event) => this.send({ do: "pace", pace: Number(event.target.value) }));
  }

  buildButtons() {
    const on = (id, act) => byId(id).addEventListener("click", (event) => {
      act();
      event.target.blur(); // the space bar is for pausing
    });
    document.querySelectorAll("[data-who]").forEach((button) =>
      button.addEventListener("click", () => this.send({ do: "lead", who: button.dataset.who })));
    document.querySelectorAll("[data-steer]").forEach((button) =>
      button.addEventListener("click", () => this.send({ do: "steer", direction: Number(button.dataset.steer) })));
    document.querySelectorAll("[data-tool]").forEach((button) =>
      button.addEventListener("click", () => this.setTool(button.dataset.tool)));
    on("push", () => this.push());
    on("restart", () => this.send({ do: "restart" }));
    on("pause", () => this.send({ do: "pause", on: !this.state.paused }));
    on("draw", () => this.setDrawing(!this.map.drawing));
    on("smaller", () => this.map.resize(-1));
    on("larger", () => this.map.resize(1));
    on("drop", () => this.send({ do: "maze", rows: this.map.rows.map((row) => row.join("")) }));
    on("train", () => this.send({ do: this.learning ? "stop" : "train" }));
    document.addEventListener("keydown", (event) => this.onKey(event));
  }

  onKey(event) {
    if (/SELECT|INPUT|TEXTAREA/.test(event.target.tagName) || event.ctrlKey || event.metaKey || event.altKey) return;
    const actions = {
      " ": () => this.send({ do: "pause", on: !this.state.paused }),
      p: () => this.push(),
      r: () => this.send({ do: "restart" }),
      f: () => this.nextCamera(),
      l: () => this.toggleTheme(),
      "?": () => byId("keys").showModal(),
    };
    const key = event.key.toLowerCase(), direction = KEYS[key], act = actions[key];
    if (direction === undefined && !act) return;
    event.preventDefault();
    if (direction === undefined) act();
    else if (!event.repeat) this.send({ do: "steer", direction });
  }

  push() {
    this.send({ do: "push", angle: Math.random() * 2 * Math.PI });
  }

  onFloor(panel, place) {
    this.send({ do: "goal", at: place });
  }

  setDrawing(drawing) {
    this.map.setDrawing(drawing);
    byId("tools").hidden = !drawing;
    byId("draw").classList.toggle("on", drawing);
    if (drawing) this.setTool("#");
  }

  setTool(tool) {
    this.map.tool = tool;
    document.querySelectorAll("[data-tool]").forEach((button) => button.classList.toggle("on", button.dataset.tool === tool));
  }

  // ------------------------------------------------ what the server says

  connect() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    this.socket = new WebSocket(`${scheme}://${location.host}/ants?visit=${visitToken()}`);
    let ended = ""; // the server's last word, if the visit ended with one
    this.socket.onmessage = (event) => {
      const message = JSON.parse(event.data);
      ended = message.is === "word" && message.bad && message.stays ? `${message.text}; ` : "";
      this.hear(message);
    };
    this.socket.onclose = (event) => {
      if (event.code === ELSEWHERE) return; // another window shows this visit
      this.say(`${ended || "the server is gone; "}trying again …`, true, true);
      setTimeout(() => this.connect(), ended ? 5000 : 2000);
    };
  }

  send(message) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }

  hear(message) {
    if (message.is === "frame") this.onFrame(message);
    else if (message.is === "scene") this.onScene(message);
    else if (message.is === "lesson") this.onLesson(message);
    else if (message.is === "word") this.say(message.text, message.bad, message.stays);
  }

  say(text, bad, stays) {
    const word = byId("word");
    word.textContent = text;
    word.classList.toggle("on", Boolean(text));
    word.classList.toggle("bad", Boolean(bad));
    clearTimeout(this.silence);
    if (!stays) this.silence = setTimeout(() => word.classList.remove("on"), 5000);
  }

  onScene(scene) {
    this.panels.forEach((panel) => panel.element.remove());
    this.panels = scene.ants.map((row) => {
      const panel = { ...scene, trace: [], row };
      const rows = [["value", "value"], ["distance", "to the goal"], ["goals", "goals"], ["falls", "falls"], ["flips", "flips"], ["steps", "control steps"]];
      this.buildCard(panel, row, scene.name, rows, true);
      if (this.renderer) panel.ribbon = this.renderer.mesh({ normals: [], offsets: [], tints: [], index: [] });
      return panel;
    });
    this.say("");
    byId("first").value = scene.ants[0];
    byId("second").value = scene.ants[1] ?? "";
    byId("arena").value = scene.name;
    if (!this.map.drawing || scene.drawn) {
      this.setDrawing(false);
      this.map.show(scene);
    }
    this.layout();
  }

  onFrame(frame) {
    if (frame.ants.length !== this.panels.length) return;
    this.state = frame;
    frame.ants.forEach((ant, i) => {
      const panel = this.panels[i], last = panel.ant;
      panel.ant = ant;
      panel.goal = ant.goal;
      const far = last && Math.hypot(ant.qpos[0] - last.qpos[0], ant.qpos[1] - last.qpos[1]) > 1.5;
      if (far) panel.trace = []; // it began anew
      if (!last || ant.steps !== last.steps) panel.trace.push([ant.qpos[0], ant.qpos[1], ant.choice]);
      if (panel.trace.length > TRACE) panel.trace.shift();
    });
    document.querySelectorAll("[data-who]").forEach((button) => {
      button.classList.toggle("on", button.dataset.who === frame.who);
      button.disabled = !frame.leaders.includes(button.dataset.who);
    });
    document.querySelectorAll("[data-steer]").forEach((button) =>
      button.classList.toggle("on", frame.who === "you" && Number(button.dataset.steer) === frame.ants[0].choice));
    byId("pause").textContent = frame.paused ? "go on" : "pause";
    byId("pause").classList.toggle("on", frame.paused);
    this.map.goal = frame.ants[0].goal;
    this.map.ants = frame.ants.map((ant) => [ant.qpos[0], ant.qpos[1], ant.choice]);
    this.dirty = true;
  }

  onLesson(lesson) {
    const of = lesson.step / lesson.total;
    if (lesson.fresh) this.curve = lesson.curve;
    this.learning = lesson.running;
    byId("lesson").hidden = false;
    byId("train").textContent = lesson.running ? "stop learning" : "train a master here";
    byId("done").value = of;
    byId("success").textContent = lesson.success === null ? "–" : `${Math.round(100 * lesson.success)} %`;
    byId("progress").textContent = lesson.progress === null ? "–" : `${lesson.progress.toFixed(1)} m`;
    byId("learned").textContent = `${Math.round(lesson.step / 1000)} k of ${Math.round(lesson.total / 1000)} k`;
    byId("rate").textContent = lesson.rate.toLocaleString("en");
    if (lesson.success !== null && !lesson.fresh) this.curve.push([of, lesson.success]);
    this.drawCurve();
    this.map.addWays(lesson.ways);
    if (lesson.error) this.say(`the lesson ended: ${lesson.error}`, true);
  }

  // ------------------------------------------------ drawing

  countFrames() {
    const rate = this.state.rate ? `${Math.round(this.state.rate)} control steps/s · ` : "";
    byId("status").textContent = `${rate}${this.frames} pictures/s`;
    this.frames = 0;
  }

  drawCurve() {
    const canvas = byId("curve"), scale = pixels(), pen = canvas.getContext("2d");
    canvas.width = canvas.clientWidth * scale;
    canvas.height = canvas.clientHeight * scale;
    const style = getComputedStyle(document.body), x = (u) => u * (canvas.width - 4) + 2, y = (v) => (1 - v) * (canvas.height - 4) + 2;
    pen.strokeStyle = style.getPropertyValue("--line");
    for (const v of [0, 0.5, 1]) pen.strokeRect(0, Math.round(y(v)) + 0.5, canvas.width, 0);
    pen.fillStyle = style.getPropertyValue("--faint");
    pen.font = `${10 * scale}px sans-serif`;
    pen.fillText("100 %", 2, 11 * scale);
    pen.strokeStyle = this.hex[0];
    pen.lineWidth = 2 * scale;
    pen.beginPath();
    this.curve.forEach(([u, v]) => pen.lineTo(x(u), y(v)));
    pen.stroke();
  }

  frame(now) {
    const elapsed = (now - (this.last ?? now)) / 1000;
    if (this.dirty) {
      this.dirty = false;
      this.last = now;
      this.spare(elapsed);
      this.draw();
      this.frames++;
    }
    requestAnimationFrame((next) => this.frame(next));
  }

  draw() {
    this.wipe();
    this.panels.filter((panel) => panel.ant).forEach((panel) => this.drawAnt(panel));
    this.map?.draw();
  }

  drawAnt(panel) {
    const { ant, trace } = panel, data = {
      frames: Float32Array.from(trace.flatMap((point) => point.slice(0, 2))), width: 2, steps: trace.length - 1,
      choice: trace.slice(1).map((point) => point[2]),
    };
    const ways = [];
    if (this.renderer && data.steps > 0) {
      this.renderer.refill(panel.ribbon, ribbonMesh(data, (choice) => this.colourOf(choice), 0.055));
      ways.push({ mesh: panel.ribbon, count: panel.ribbon.count });
    }
    const pieces = () => data.choice.map((choice, i) => [...trace[i].slice(0, 2), ...trace[i + 1].slice(0, 2), this.colourOf(choice)]);
    this.drawPanel(panel, ant.qpos, this.colourOf(ant.choice), ways, pieces);
    this.drawCard(panel);
  }

  drawCard({ hud, ant }) {
    this.showChoice(hud, ant.choice);
    hud.value.textContent = ant.value === null ? "–" : ant.value.toFixed(1);
    hud.distance.textContent = ant.distance === null ? "–" : `${ant.distance.toFixed(2)} m`;
    for (const key of ["goals", "falls", "flips"]) hud[key].textContent = ant[key];
    hud.steps.textContent = ant.steps.toLocaleString("en");
    hud.oddsRow.hidden = !ant.odds;
    if (ant.odds) hud.odds.forEach((bar, i) => (bar.style.height = `${100 * ant.odds[i]}%`));
    const [text, colour] = ant.flipped ? ["upside down", "#B3261E"] : ant.fallen ? ["fallen", "#B3261E"]
      : ant.arrived ? ["at the goal", "#009E73"] : ["", ""];
    this.showBadge(hud, text, colour);
  }
}

// The maze from above: shows the ways of learning ants as they fade, and is drawn on.
class FloorMap {
  constructor(canvas, hex) {
    Object.assign(this, { canvas, hex, ants: [], goal: null, drawing: false, tool: "#", rows: blank(5) });
    this.ways = document.createElement("canvas");
    const paint = (event) => {
      if (!this.drawing || !(event.buttons & 1)) return;
      const box = canvas.getBoundingClientRect(), n = this.rows.length, m = this.rows[0].length;
      this.put(Math.floor(((event.clientY - box.top) / box.height) * n), Math.floor(((event.clientX - box.left) / box.width) * m));
    };
    canvas.addEventListener("pointerdown", paint);
    canvas.addEventListener("pointermove", paint);
  }

  // What stands in a cell; of starts and goals there is one.
  put(i, j) {
    const inside = i > 0 && j > 0 && i < this.rows.length - 1 && j < this.rows[0].length - 1;
    if (!inside) return;
    if ("rg".includes(this.tool)) this.rows = this.rows.map((row) => row.map((cell) => (cell === this.tool ? "." : cell)));
    this.rows[i][j] = this.tool;
    this.draw();
  }

  resize(by) {
    const old = this.rows, n = Math.max(4, Math.min(13, old.length + by)), m = Math.max(4, Math.min(13, old[0].length + by));
    const inner = (i, size) => i > 0 && i < size - 1;
    this.rows = Array.from({ length: n }, (_, i) => Array.from({ length: m }, (_, j) => {
      if (!inner(i, n) || !inner(j, m)) return "#";
      return inner(i, old.length) && inner(j, old[0].length) ? old[i][j] : ".";
    }));
    this.draw();
  }

  setDrawing(drawing) {
    this.drawing = drawing;
    this.canvas.classList.toggle("drawing", drawing);
    if (drawing && this.scene && !this.scene.grid.length) this.rows = blank(5);
    this.draw();
  }

  show(scene) {
    this.scene = scene;
    if (scene.grid.length) this.rows = scene.grid.map((row) => [...row]);
    this.ways.width = this.ways.height = 0;
    this.draw();
  }

  // The view in m: [left, top, width, height] and the pen's scale.
  frame() {
    const { scene, canvas } = this, cell = scene?.cell ?? 4;
    const grid = this.drawing || scene?.grid.length;
    const [x, y, halfX, halfY] = grid ? [0, 0, (this.rows[0].length * cell) / 2, (this.rows.length * cell) / 2] : scene?.extent ?? [0, 0, 10, 10];
    const width = canvas.clientWidth * pixels(), scale = width / (2 * halfX);
    return { left: x - halfX, top: y + halfY, width, height: Math.round(scale * 2 * halfY), scale, cell, grid };
  }

  addWays(ways) {
    if (this.drawing || !this.scene) return;
    const { left, top, width, height, scale } = this.frame(), { ways: sheet } = this;
    if (sheet.width !== Math.round(width) || sheet.height !== height) Object.assign(sheet, { width, height });
    const pen = sheet.getContext("2d");
    pen.globalCompositeOperation = "destination-out";
    pen.fillStyle = `rgba(0, 0, 0, ${ways.length ? 0.16 : 0})`;
    pen.fillRect(0, 0, width, height);
    pen.globalCompositeOperation = "source-over";
    pen.lineWidth = 1.1 * pixels();
    for (const [ax, ay, bx, by, choice] of ways) {
      pen.strokeStyle = this.hex[choice];
      pen.beginPath();
      pen.moveTo((ax / 100 - left) * scale, (top - ay / 100) * scale);
      pen.lineTo((bx / 100 - left) * scale, (top - by / 100) * scale);
      pen.stroke();
    }
  }

  draw() {
    const { left, top, width, height, scale, cell, grid } = this.frame(), { canvas, scene } = this;
    if (!width) return;
    Object.assign(canvas, { width, height });
    canvas.style.height = `${height / pixels()}px`;
    const pen = canvas.getContext("2d"), style = getComputedStyle(document.body);
    const dot = (x, y, r, colour) => {
      pen.fillStyle = colour;
      pen.beginPath();
      pen.arc((x - left) * scale, (top - y) * scale, r, 0, 7);
      pen.fill();
    };
    if (grid) {
      this.rows.forEach((row, i) => row.forEach((letter, j) => {
        pen.fillStyle = letter === "#" ? "#8b8f98" : style.getPropertyValue("--button");
        pen.fillRect(j * cell * scale, i * cell * scale, cell * scale + 0.5, cell * scale + 0.5);
        if (this.drawing) {
          pen.strokeStyle = style.getPropertyValue("--line");
          pen.strokeRect(j * cell * scale, i * cell * scale, cell * scale, cell * scale);
        }
        const mark = { r: style.color, g: GOAL }[letter];
        if (this.drawing && mark) {
          pen.fillStyle = mark;
          pen.beginPath();
          pen.arc((j + 0.5) * cell * scale, (i + 0.5) * cell * scale, 0.28 * cell * scale, 0, 7);
          pen.fill();
        }
      }));
    } else {
      pen.fillStyle = style.getPropertyValue("--button");
      pen.fillRect(0, 0, width, height);
    }
    if (this.drawing || !scene) return;
    if (this.ways.width) pen.drawImage(this.ways, 0, 0);
    if (this.goal) dot(...this.goal, Math.max(4, 0.5 * scale), GOAL);
    this.ants.forEach(([x, y, choice]) => dot(x, y, 5 * pixels(), this.hex[choice] ?? "#777"));
  }
}

const blank = (size) => Array.from({ length: size }, (_, i) => Array.from({ length: size }, (_, j) => {
  if (i === 0 || j === 0 || i === size - 1 || j === size - 1) return "#";
  return i === size - 2 && j === 1 ? "r" : i === 1 && j === size - 2 ? "g" : ".";
}));

const live = new Live(JSON.parse(byId("world").textContent));
window.footwork = live;
requestAnimationFrame((now) => live.frame(now));
