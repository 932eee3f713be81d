"use strict";
// Draws surfaces and points on canvases that can be turned and zoomed. Data comes from <script type="application/json">
// elements: {range: [x0, x1, y0, y1, z0, z1], surface: {rows, columns, z: [...]} | null, points: [[x, y, z], ...], flat}.
(() => {
  const VIRIDIS = [[68, 1, 84], [71, 44, 122], [59, 81, 139], [44, 113, 142], [33, 144, 141], [39, 173, 129], [92, 200, 99], [170, 220, 50], [253, 231, 37]];
  const colour = (t) => {
    const s = Math.min(0.9999, Math.max(0, t)) * (VIRIDIS.length - 1), i = Math.floor(s), f = s - i;
    return VIRIDIS[i].map((v, k) => v + f * (VIRIDIS[i + 1][k] - v));
  };
  const START = { turn: -0.92, tilt: 0.52, zoom: 1 };

  class View {
    constructor(canvas) {
      this.canvas = canvas;
      this.group = canvas.dataset.group;
      this.data = JSON.parse(document.getElementById(canvas.dataset.source).textContent);
      this.camera = { ...START };
      if (this.data.flat) Object.assign(this.camera, { turn: 0, tilt: Math.PI / 2 });
      this.build();
      this.listen();
    }

    // Everything into the cube [-1, 1]^2 x [-0.62, 0.62]: heights are drawn flatter than they are wide, as in the paper.
    build() {
      const [x0, x1, y0, y1, z0, z1] = this.data.range;
      const flat = this.data.flat;
      const place = (x, y, z) => [2 * (x - x0) / (x1 - x0) - 1, 2 * (y - y0) / (y1 - y0) - 1, flat ? 0 : 1.24 * (Math.min(z1 + 0.35 * (z1 - z0), Math.max(z0 - 0.35 * (z1 - z0), z)) - z0) / (z1 - z0) - 0.62];
      this.quads = [];
      const s = this.data.surface;
      if (s) {
        const node = (i, j) => place(x0 + (x1 - x0) * j / (s.columns - 1), y0 + (y1 - y0) * i / (s.rows - 1), s.z[i * s.columns + j]);
        for (let i = 0; i + 1 < s.rows; i++) for (let j = 0; j + 1 < s.columns; j++) {
          const c = [node(i, j), node(i, j + 1), node(i + 1, j + 1), node(i + 1, j)];
          const mean = (s.z[i * s.columns + j] + s.z[i * s.columns + j + 1] + s.z[(i + 1) * s.columns + j + 1] + s.z[(i + 1) * s.columns + j]) / 4;
          const u = c[2].map((v, k) => v - c[0][k]), v = c[3].map((w, k) => w - c[1][k]);
          const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
          const light = (0.42 * -n[0] + 0.30 * -n[1] + 0.86 * n[2]) / (Math.hypot(...n) || 1);
          const shade = 0.72 + 0.28 * light;
          const rgb = colour((mean - z0) / (z1 - z0)).map((k) => Math.round(Math.min(255, k * shade)));
          this.quads.push({ corners: c, fill: `rgb(${rgb})`, edge: `rgb(${rgb.map((k) => Math.round(k * 0.86))})` });
        }
      }
      this.points = (this.data.points || []).map(([x, y, z]) => ({ at: place(x, y, z), fill: `rgb(${colour((z - z0) / (z1 - z0)).map(Math.round)})` }));
      this.floor = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([x, y]) => [x, y, flat ? 0 : -0.62]);
    }

    project([x, y, z]) {
      const { turn, tilt, zoom } = this.camera, a = Math.cos(turn), b = Math.sin(turn);
      const right = x * a - y * b, into = x * b + y * a;
      const up = z * Math.cos(tilt) + into * Math.sin(tilt), depth = into * Math.cos(tilt) - z * Math.sin(tilt);
      const scale = this.size * 0.292 * zoom / (1 + 0.09 * depth);
      return [this.size / 2 + right * scale, this.size * 0.48 - up * scale, depth];
    }

    draw() {
      const ratio = window.devicePixelRatio || 1, side = Math.round(this.canvas.clientWidth * ratio);
      if (!side) return;
      if (this.canvas.width !== side) { this.canvas.width = side; this.canvas.height = side; }
      this.size = side;
      const g = this.canvas.getContext("2d");
      g.clearRect(0, 0, side, side);
      const path = (corners) => { g.beginPath(); corners.forEach((c, k) => (k ? g.lineTo(c[0], c[1]) : g.moveTo(c[0], c[1]))); g.closePath(); };
      path(this.floor.map((c) => this.project(c)));
      g.fillStyle = "#f5f7f9"; g.fill(); g.strokeStyle = "#aab4bf"; g.lineWidth = ratio; g.stroke();
      const items = this.quads.map((q) => {
        const c = q.corners.map((p) => this.project(p));
        return { depth: (c[0][2] + c[2][2]) / 2, c, q };
      });
      for (const p of this.points) { const c = this.project(p.at); items.push({ depth: c[2] - 0.02, c, p }); }
      items.sort((m, n) => n.depth - m.depth);
      g.lineWidth = 0.55 * ratio;
      for (const item of items) {
        if (item.q) { path(item.c); g.fillStyle = item.q.fill; g.fill(); g.strokeStyle = item.q.edge; g.stroke(); continue; }
        if (!this.data.flat) {
          const foot = this.project([item.p.at[0], item.p.at[1], -0.62]);
          g.beginPath(); g.moveTo(foot[0], foot[1]); g.lineTo(item.c[0], item.c[1]); g.strokeStyle = "rgba(91,102,117,.28)"; g.stroke();
        }
        g.beginPath(); g.arc(item.c[0], item.c[1], 2.6 * ratio * Math.sqrt(this.camera.zoom), 0, 7);
        g.fillStyle = item.p.fill; g.fill(); g.strokeStyle = "#1c2430"; g.stroke();
      }
      this.label(g, ratio);
    }

    label(g, ratio) {
      const [x0, x1, y0, y1, z0, z1] = this.data.range, show = (v) => String(+v.toPrecision(3));
      g.font = `${11 * ratio}px system-ui, "DejaVu Sans", sans-serif`; g.fillStyle = "#5b6675"; g.textAlign = "center"; g.textBaseline = "middle";
      g.strokeStyle = "rgba(255,255,255,.85)"; g.lineWidth = 3 * ratio; g.lineJoin = "round";
      // Within the canvas, legible on the surface; `up` keeps the heights off the labels of the corner they stand on.
      const low = this.data.flat ? 0 : -0.62, at = (p, text, up = 0) => {
        const c = this.project(p), half = g.measureText(text).width / 2 + ratio;
        const x = Math.min(this.size - half, Math.max(half, c[0])), y = c[1] - up * ratio;
        g.strokeText(text, x, y); g.fillText(text, x, y);
      };
      at([-1, -1.2, low], show(x0)); at([0, -1.24, low], "x"); at([1, -1.2, low], show(x1));
      at([1.22, -1, low], show(y0)); at([1.26, 0, low], "y"); at([1.22, 1, low], show(y1));
      if (this.data.flat) return;
      at([-1.14, -1.06, -0.62], show(z0), 8); at([-1.14, -1.06, 0], "z", 8); at([-1.14, -1.06, 0.62], show(z1), 8);
    }

    listen() {
      const c = this.canvas, pointers = new Map();
      let gap = 0;
      c.addEventListener("pointerdown", (e) => { c.setPointerCapture(e.pointerId); pointers.set(e.pointerId, e); gap = 0; });
      c.addEventListener("pointermove", (e) => {
        const last = pointers.get(e.pointerId);
        if (!last) return;
        pointers.set(e.pointerId, e);
        if (pointers.size === 2) {
          const [p, q] = [...pointers.values()], now = Math.hypot(p.clientX - q.clientX, p.clientY - q.clientY);
          if (gap) this.move({ zoom: now / gap });
          gap = now;
        } else this.move({ turn: (e.clientX - last.clientX) * 0.011, tilt: (e.clientY - last.clientY) * 0.009 });
      });
      for (const name of ["pointerup", "pointercancel"]) c.addEventListener(name, (e) => { pointers.delete(e.pointerId); gap = 0; });
      // The wheel scrolls the page unless this panel was clicked: a page of thirty panels must stay scrollable.
      c.addEventListener("wheel", (e) => { if (document.activeElement === c || e.ctrlKey) { e.preventDefault(); this.move({ zoom: Math.exp(-e.deltaY * 0.0015) }); } }, { passive: false });
      c.addEventListener("dblclick", () => this.reset());
      c.addEventListener("keydown", (e) => {
        const step = { ArrowLeft: { turn: -0.1 }, ArrowRight: { turn: 0.1 }, ArrowUp: { tilt: -0.08 }, ArrowDown: { tilt: 0.08 }, "+": { zoom: 1.15 }, "=": { zoom: 1.15 }, "-": { zoom: 1 / 1.15 } }[e.key];
        if (step) { e.preventDefault(); this.move(step); } else if (e.key === "Home" || e.key === "0") this.reset();
      });
    }

    move({ turn = 0, tilt = 0, zoom = 1 }) {
      for (const v of this.mates()) {
        const k = v.camera;
        if (!v.data.flat) { k.turn += turn; k.tilt = Math.min(Math.PI / 2, Math.max(-0.25, k.tilt + tilt)); }
        k.zoom = Math.min(6, Math.max(0.4, k.zoom * zoom));
        v.later();
      }
    }

    reset() {
      for (const v of this.mates()) { if (v.data.flat) v.camera.zoom = 1; else v.camera = { ...START }; v.later(); }
    }

    mates() {
      const box = document.querySelector(`input[data-link="${this.group}"]`);
      return box && box.checked ? views.filter((v) => v.group === this.group) : [this];
    }

    later() {
      if (this.pending) return;
      this.pending = true;
      requestAnimationFrame(() => { this.pending = false; this.draw(); });
    }
  }

  const views = [...document.querySelectorAll("canvas[data-source]")].map((c) => new View(c));
  views.forEach((v) => { new ResizeObserver(() => v.later()).observe(v.canvas); v.later(); });
  document.querySelectorAll("button[data-reset]").forEach((b) => b.addEventListener("click", () => views.filter((v) => v.group === b.dataset.reset).forEach((v) => { v.reset(); })));
})();
