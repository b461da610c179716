// The replay of recorded episodes: play, scrub, speed. Follows scene.js in the page.

// ---------------------------------------------------------------- decoding

const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));

// One episode's numbers; frames are [T + 1, 15], each column quantised to 16 bits between its own bounds.
function decode(episode) {
  const packed = new Uint16Array(bytes(episode.frames).buffer);
  const width = episode.low.length;
  const frames = new Float32Array(packed.length);
  for (let i = 0; i < packed.length; i++) frames[i] = episode.low[i % width] + episode.step[i % width] * packed[i];
  return {
    frames,
    width,
    steps: packed.length / width - 1,
    choice: new Int8Array(bytes(episode.choice).buffer),
    total: new Float32Array(bytes(episode.total).buffer),
    distance: new Float32Array(bytes(episode.distance).buffer),
    flags: bytes(episode.flags), // 1 fallen, 2 upside down
    odds: bytes(episode.odds), // [decisions, 4], 255 is certain; empty where nobody chooses
    value: new Float32Array(bytes(episode.value).buffer), // [decisions], empty where the critic is not at hand
  };
}

// The pose at a time in control steps: linear, and the quaternion along the shorter arc.
function poseAt(data, time) {
  const at = Math.max(0, Math.min(time, data.steps));
  const i = Math.min(Math.floor(at), Math.max(data.steps - 1, 0));
  const u = at - i;
  const a = i * data.width;
  const b = Math.min(i + 1, data.steps) * data.width;
  const f = data.frames;
  let dot = 0;
  for (let k = 3; k < 7; k++) dot += f[a + k] * f[b + k];
  const q = [];
  for (let k = 0; k < data.width; k++) {
    const sign = k >= 3 && k < 7 && dot < 0 ? -1 : 1;
    q.push(f[a + k] * (1 - u) + sign * f[b + k] * u);
  }
  const norm = Math.hypot(q[3], q[4], q[5], q[6]) || 1;
  for (let k = 3; k < 7; k++) q[k] /= norm;
  return q;
}

// ---------------------------------------------------------------- the page

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4, 8];

class Viewer extends Stage {
  constructor(footage) {
    super(footage);
    this.footage = footage;
    this.panels = this.episodes = footage.episodes.map((episode) => ({ ...episode, data: decode(episode) }));
    this.steps = Math.max(...this.episodes.map((episode) => episode.data.steps));
    this.time = 0;
    this.playing = false;
    this.buildLegend(new Set(this.episodes.flatMap((episode) => Array.from(episode.data.choice))));
    this.episodes.forEach((episode) => this.buildPanel(episode));
    this.buildTracks();
    this.buildControls();
    this.open();
  }

  buildPanel(episode) {
    const rows = [["return", "return"], ["distance", episode.goal ? "to the goal" : "walked"]];
    if (episode.data.value.length) rows.push(["value", "value"]);
    const hud = this.buildCard(episode, episode.row, episode.label, rows, episode.data.odds.length > 0);
    hud.spark = element("canvas", "spark");
    hud.card.insertBefore(hud.spark, hud.oddsRow ?? null);
    if (this.renderer) episode.ribbon = this.renderer.mesh(ribbonMesh(episode.data, (c) => this.colourOf(c), 0.055));
  }

  layout() {
    this.drawTracks();
    super.layout();
  }

  buildTracks() {
    const tracks = document.getElementById("tracks");
    const height = Math.max(5, Math.min(14, 48 / this.episodes.length));
    for (const episode of this.episodes) {
      const track = element("canvas", "track", tracks);
      track.style.height = `${height}px`;
      track.title = `${episode.row}, ${episode.label}`;
      episode.track = track;
    }
    this.head = element("div", "", tracks);
    this.head.id = "head";
    tracks.setAttribute("aria-valuemax", this.steps);
    const scrub = (event) => {
      const box = tracks.getBoundingClientRect();
      this.seek(((event.clientX - box.left) / box.width) * this.steps);
    };
    tracks.addEventListener("pointerdown", (event) => {
      tracks.setPointerCapture(event.pointerId);
      this.resume = this.playing;
      this.setPlaying(false);
      scrub(event);
    });
    tracks.addEventListener("pointermove", (event) => tracks.hasPointerCapture(event.pointerId) && scrub(event));
    tracks.addEventListener("pointerup", () => this.resume && this.setPlaying(true));
  }

  drawTracks() {
    for (const episode of this.episodes) {
      const { track, data } = episode;
      track.width = track.clientWidth * pixels();
      track.height = track.clientHeight * pixels();
      const pen = track.getContext("2d"), scale = track.width / this.steps;
      for (let i = 0; i < data.steps; i++) {
        let end = i + 1;
        while (end < data.steps && data.choice[end] === data.choice[i] && data.flags[end] === data.flags[i]) end++;
        const choice = data.choice[i];
        pen.fillStyle = choice < 0 ? this.flatHex : this.hex[choice];
        pen.fillRect(i * scale, 0, (end - i) * scale + 0.5, track.height);
        if (data.flags[i] & 2) { // upside down: a dark line below
          pen.fillStyle = "#000b";
          pen.fillRect(i * scale, track.height * 0.6, (end - i) * scale + 0.5, track.height * 0.4);
        }
        i = end - 1;
      }
    }
  }

  buildControls() {
    const on = (id, name, act) => document.getElementById(id).addEventListener(name, act);
    const speeds = document.getElementById("speed");
    SPEEDS.forEach((speed) => (element("option", "", speeds, `${speed} ×`).value = speed));
    on("play", "click", () => this.toggle());
    on("back", "click", () => this.nudge(-1));
    on("forth", "click", () => this.nudge(1));
    on("speed", "change", (event) => this.setSpeed(Number(event.target.value)));
    this.setSpeed(1);
    document.addEventListener("keydown", (event) => this.onKey(event));
  }

  onKey(event) {
    if (event.target.tagName === "SELECT" || event.ctrlKey || event.metaKey || event.altKey) return;
    const half = Math.round(0.5 / this.footage.control_dt);
    const faster = (by) => this.setSpeed(SPEEDS[Math.max(0, Math.min(SPEEDS.length - 1, SPEEDS.indexOf(this.speed) + by))]);
    const actions = {
      " ": () => this.toggle(),
      ArrowLeft: () => this.nudge(-half),
      ArrowRight: () => this.nudge(half),
      ",": () => this.nudge(-1),
      ".": () => this.nudge(1),
      ArrowUp: () => faster(1),
      ArrowDown: () => faster(-1),
      Home: () => this.seek(0),
      End: () => this.seek(this.steps),
      f: () => this.nextCamera(),
      l: () => this.toggleTheme(),
      "?": () => document.getElementById("keys").showModal(),
    };
    const act = actions[event.key] || actions[event.key.toLowerCase()];
    if (!act) return;
    event.preventDefault();
    act();
  }

  toggle() {
    if (!this.playing && this.time >= this.steps) this.time = 0;
    this.setPlaying(!this.playing);
  }

  setPlaying(playing) {
    this.playing = playing;
    document.getElementById("play").textContent = playing ? "❚❚" : "▶";
    this.dirty = true;
  }

  setSpeed(speed) {
    this.speed = speed;
    document.getElementById("speed").value = speed;
  }

  nudge(steps) {
    this.setPlaying(false);
    this.seek(Math.round(this.time) + steps);
  }

  seek(time) {
    this.time = Math.max(0, Math.min(this.steps, time));
    this.dirty = true;
  }

  // Which choice, flags and sums hold at a time: those of the control step that led there.
  index(episode) {
    return Math.max(0, Math.min(episode.data.steps, Math.ceil(this.time - 1e-6)) - 1);
  }

  draw() {
    this.wipe();
    for (const episode of this.episodes) {
      const tint = this.colourOf(episode.data.choice[this.index(episode)] ?? -1);
      const walked = Math.min(Math.ceil(this.time), episode.data.steps);
      const ways = [{ mesh: episode.ribbon, count: 6 * walked }];
      this.drawPanel(episode, poseAt(episode.data, this.time), tint, ways, () => this.pieces(episode.data, walked));
      this.drawCard(episode);
    }
    this.head.style.left = `${(100 * this.time) / this.steps}%`;
    const dt = this.footage.control_dt;
    document.getElementById("clock").textContent =
      `${(this.time * dt).toFixed(2)} s of ${(this.steps * dt).toFixed(2)} s · control step ${Math.round(this.time)}`;
    document.getElementById("tracks").setAttribute("aria-valuenow", Math.round(this.time));
  }

  pieces(data, walked) {
    const at = (i, k) => data.frames[i * data.width + k];
    const piece = (i) => [at(i, 0), at(i, 1), at(i + 1, 0), at(i + 1, 1), this.colourOf(data.choice[i])];
    return Array.from({ length: walked }, (_, i) => piece(i));
  }

  drawCard(episode) {
    const { hud, data, goal, start } = episode, i = this.index(episode), begun = this.time > 0;
    this.showChoice(hud, data.choice[i] ?? -1);
    hud.return.textContent = (begun ? data.total[i] : 0).toFixed(1);
    const place = poseAt(data, this.time);
    const away = goal ? Math.hypot(place[0] - goal[0], place[1] - goal[1]) : Math.hypot(place[0] - start[0], place[1] - start[1]);
    hud.distance.textContent = `${away.toFixed(2)} m`;
    const decision = Math.floor(i / episode.option_steps);
    if (hud.value) hud.value.textContent = data.value[decision].toFixed(1);
    if (hud.odds) hud.odds.forEach((bar, k) => (bar.style.height = `${(100 * data.odds[4 * decision + k]) / 255}%`));
    const over = this.time >= data.steps;
    const [text, colour] = over ? [episode.outcome, episode.good ? "#009E73" : "#5c616b"]
      : begun && data.flags[i] & 2 ? ["upside down", "#B3261E"]
      : begun && data.flags[i] & 1 ? ["fallen", "#B3261E"] : ["", ""];
    this.showBadge(hud, text, colour);
    this.drawSpark(hud.spark, data, i);
  }

  // The return so far, and what is still to come.
  drawSpark(spark, data, now) {
    if (!spark.clientWidth) return;
    spark.width = spark.clientWidth * pixels();
    spark.height = spark.clientHeight * pixels();
    const pen = spark.getContext("2d");
    let low = 0, high = 0;
    for (const total of data.total) {
      low = Math.min(low, total);
      high = Math.max(high, total);
    }
    const x = (i) => (i / Math.max(this.steps - 1, 1)) * (spark.width - 4) + 2;
    const y = (v) => spark.height - 3 - ((v - low) / (high - low || 1)) * (spark.height - 6);
    const ink = getComputedStyle(document.body).color;
    for (const [from, to, alpha] of [[0, data.steps - 1, 0.22], [0, now, 1]]) {
      pen.globalAlpha = alpha;
      pen.strokeStyle = pen.fillStyle = ink;
      pen.lineWidth = 1.4 * pixels();
      pen.beginPath();
      for (let i = from; i <= to; i += Math.max(1, Math.floor(data.steps / 400))) pen.lineTo(x(i), y(data.total[i]));
      pen.stroke();
    }
    pen.beginPath();
    pen.arc(x(now), y(data.total[now] ?? 0), 2.2 * pixels(), 0, 7);
    pen.fill();
  }

  frame(now) {
    const elapsed = Math.min((now - (this.last ?? now)) / 1000, 0.25);
    this.last = now;
    if (this.playing) {
      this.time = Math.min(this.steps, this.time + (elapsed * this.speed) / this.footage.control_dt);
      if (this.time >= this.steps) this.setPlaying(false);
    }
    if (this.playing || this.dirty) {
      this.dirty = false;
      if (this.playing) this.spare(elapsed);
      this.draw();
    }
    requestAnimationFrame((next) => this.frame(next));
  }
}

if (typeof document === "undefined") {
  module.exports = { decode, poseAt, geomPoses }; // to be tested without a browser
} else {
  const viewer = new Viewer(JSON.parse(document.getElementById("footage").textContent));
  window.footwork = viewer;
  requestAnimationFrame((now) => viewer.frame(now));
  if (!window.matchMedia("(prefers-reduced-motion: reduce)").matches) viewer.setPlaying(true);
}
