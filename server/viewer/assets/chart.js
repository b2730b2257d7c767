// A small chart of the last minute, with its latest values as text.

const SPAN = 60, HEIGHT = 62, LEFT = 34, BOTTOM = 15, TOP = 5;
// A longer pause between two samples is a gap: nothing is known of it [s].
const GAP = 2.6;
// The axis ends at this multiple of what nine of ten samples stay below.
const PEAK = 3;
const INK = "#93a4b8", GRID = "#2a3749";

export class Chart {
  /** parent: element for the chart.  title, unit: of the values.  series: list of {name, label, colour,
   * kind: "area" (stacked on the ones before), "line" or "dash"}.  format: returns the text of a value.
   * logarithmic: values from 0 to thousands are all seen. */
  constructor(parent, { title, unit, series = [], format, logarithmic = false }) {
    Object.assign(this, { title, unit, format, logarithmic });
    this.figure = document.createElement("figure");
    const caption = document.createElement("figcaption");
    caption.textContent = `${title} `;
    const shown = document.createElement("span");
    shown.textContent = `[${unit}]`;
    caption.append(shown);
    this.canvas = document.createElement("canvas");
    this.canvas.setAttribute("role", "img");
    this.legend = document.createElement("ul");
    this.legend.className = "legend values";
    this.figure.append(caption, this.canvas, this.legend);
    parent.append(this.figure);
    this.setSeries(series);
  }

  setSeries(series) {
    this.series = series;
    this.values = series.map(({ label, colour, kind }) => {
      const item = document.createElement("li"), patch = document.createElement("i");
      const value = document.createElement("b");
      patch.style.background = colour;
      if (label.length > 14) item.className = "wide";
      if (kind !== "area") patch.className = kind;
      value.textContent = "–";
      item.append(patch, label, value);
      return { item, value };
    });
    this.legend.replaceChildren(...this.values.map(({ item }) => item));
  }

  /** Draw samples {time, name: value}, oldest first. now: end of the minute, on the clock of `time` [s]. */
  draw(samples, now) {
    const shown = samples.filter(({ time }) => now - time < SPAN + GAP);
    this.label(shown, now);
    const width = this.canvas.clientWidth;
    if (!width) return;
    const ratio = window.devicePixelRatio || 1;
    Object.assign(this.canvas, { width: Math.round(width * ratio), height: Math.round(HEIGHT * ratio) });
    const pen = this.canvas.getContext("2d");
    pen.scale(ratio, ratio);
    const heights = shown.map((each) => this.highest(each)).sort((one, other) => one - other);
    const most = heights.at(-1) ?? 0, usual = heights[Math.floor(0.9 * (heights.length - 1))] ?? 0;
    // A single second that is far above the others is cut, and marked: they would not be seen.
    const top = niceTop(this.logarithmic || !usual ? most : Math.min(most, PEAK * usual), this.logarithmic);
    const x = (time) => LEFT + (width - LEFT - 1) * (1 - (now - time) / SPAN);
    const y = (value) => TOP + (HEIGHT - TOP - BOTTOM) * (1 - this.share(value, top));
    this.axes(pen, width, top, y);
    pen.save();
    pen.beginPath();
    pen.rect(LEFT, 0, width - LEFT, HEIGHT - BOTTOM + 1);
    pen.clip();
    for (const run of runs(shown)) this.run(pen, run, x, y);
    pen.restore();
    pen.fillStyle = INK;
    for (const each of shown) if (this.highest(each) > top) mark(pen, x(each.time));
  }

  share(value, top) {
    return this.logarithmic ? Math.log1p(value) / Math.log1p(top) : value / top;
  }

  /** Return the highest point that a sample draws. */
  highest(each) {
    let stack = 0, most = 0;
    for (const { name, kind } of this.series) {
      const value = each[name] ?? 0;
      if (kind === "area") stack += value;
      most = Math.max(most, stack, value);
    }
    return most;
  }

  axes(pen, width, top, y) {
    pen.font = "10.5px system-ui, sans-serif";
    pen.fillStyle = INK;
    pen.strokeStyle = GRID;
    pen.lineWidth = 1;
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    for (const value of ticks(top, this.logarithmic)) {
      const at = Math.round(y(value)) + 0.5;
      pen.beginPath();
      pen.moveTo(LEFT, at);
      pen.lineTo(width, at);
      pen.stroke();
      pen.fillText(short(value), LEFT - 5, at);
    }
    pen.textBaseline = "alphabetic";
    pen.textAlign = "left";
    pen.fillText("60 s ago", LEFT, HEIGHT - 2);
    pen.textAlign = "right";
    pen.fillText("now", width, HEIGHT - 2);
  }

  /** Draw samples without a gap. */
  run(pen, samples, x, y) {
    const below = samples.map(() => 0);
    for (const { name, colour, kind } of this.series) {
      const known = samples.map((each) => each[name] ?? null);
      pen.fillStyle = pen.strokeStyle = colour;
      pen.lineWidth = kind === "area" ? 1 : 1.6;
      pen.setLineDash(kind === "dash" ? [4, 3] : []);
      pen.beginPath();
      if (kind === "area") {
        const above = samples.map((_, k) => below[k] + (known[k] ?? 0));
        samples.forEach(({ time }, k) => pen.lineTo(x(time), y(above[k])));
        for (let k = samples.length - 1; k >= 0; k -= 1) {
          pen.lineTo(x(samples[k].time), y(below[k]));
          below[k] = above[k];
        }
        pen.globalAlpha = 0.82;
        pen.fill();
        pen.globalAlpha = 1;
        continue;
      }
      let drawn = false;
      samples.forEach(({ time }, k) => {
        if (known[k] === null) drawn = false;
        else if (drawn) pen.lineTo(x(time), y(known[k]));
        else {
          pen.moveTo(x(time), y(known[k]));
          drawn = true;
        }
      });
      pen.stroke();
    }
    pen.setLineDash([]);
  }

  /** Show the latest values as text. */
  label(samples, now) {
    const last = samples.at(-1);
    const fresh = last && now - last.time < GAP ? last : {};
    const texts = this.series.map(({ name }) => (fresh[name] === undefined || fresh[name] === null
      ? "–" : this.format(fresh[name])));
    texts.forEach((text, k) => { this.values[k].value.textContent = text; });
    this.canvas.setAttribute("aria-label",
      `${this.title} in ${this.unit} over the last minute; now ${this.series.map(({ label }, k) => `${label} ${texts[k]}`).join(", ")}`);
  }
}

/** Mark a value that is above the axis. */
function mark(pen, x) {
  pen.beginPath();
  pen.moveTo(x - 3, TOP + 5);
  pen.lineTo(x + 3, TOP + 5);
  pen.lineTo(x, TOP);
  pen.fill();
}

/** Yield samples in pieces without gaps. */
function* runs(samples) {
  let piece = [];
  for (const each of samples) {
    if (piece.length && each.time - piece.at(-1).time > GAP) {
      yield piece;
      piece = [];
    }
    piece.push(each);
  }
  if (piece.length) yield piece;
}

/** Return the end of an axis: 1, 2 or 5 times a power of ten; a power of ten of a logarithmic one. */
function niceTop(most, logarithmic) {
  if (!(most > 0)) return logarithmic ? 10 : 1;
  const power = 10 ** Math.floor(Math.log10(most));
  if (logarithmic) return Math.max(10, most > power ? 10 * power : power);
  return [1, 2, 5, 10].find((each) => each * power >= most * 1.0001) * power;
}

function ticks(top, logarithmic) {
  if (!logarithmic) return [0, top / 2, top];
  const found = [0];
  const step = top > 1000 ? 100 : 10;
  for (let value = step; value <= top; value *= step) found.push(value);
  return found;
}

/** Return a short text of a number of an axis. */
function short(value) {
  return value >= 1000 ? `${value / 1000}k` : String(Number(value.toPrecision(3)));
}
