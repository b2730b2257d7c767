// How much is drawn: as the settings say when nothing moves, and as much as stays smooth when it does.
//
// A picture that did not change is not drawn again. Where graphics are computed in software, a point
// takes about a microsecond, and a moving picture has fewer points than a still one.

const SMOOTH_MS = 42, EASY_MS = 24;
const LEAST_POINTS = 25e3, FIRST_SOFTWARE = 60e3;
// A view that has not changed for this long is drawn in full [ms].
const STILL_MS = 240;
const GATHERED_MS = 1500;

export class Quality {
  /** software: whether there is no graphics processor. */
  constructor(software) {
    this.software = software;
    this.most = software ? FIRST_SOFTWARE : Infinity;
    this.intervals = [];
    this.seen = "";
    this.chosen = "";
    this.content = "";
    this.latest = "";
    this.changed = 0;
    this.drawn = 0;
    this.full = false;
  }

  /** Note what a picture depends on. Returns whether the picture must be drawn.
   *
   * seen: text of the camera and all that moves.  chosen: text of settings.  content: text of the
   * scan that has arrived.  now: [ms].
   */
  look(seen, chosen, content, now) {
    this.latest = content;
    if (seen !== this.seen) {
      Object.assign(this, { seen, chosen, content, changed: now, full: false });
      return true;
    }
    if (chosen !== this.chosen) {
      Object.assign(this, { chosen, content, drawn: now });
      return true;
    }
    // In software a full picture takes a second: new tiles are gathered.
    if (content !== this.content && (!this.software || !this.full || now - this.drawn > GATHERED_MS)) {
      Object.assign(this, { content, drawn: now });
      return true;
    }
    if (this.full || now - this.changed < STILL_MS) return false;
    Object.assign(this, { full: true, drawn: now });
    return true;
  }

  /** Return whether the view is at rest, and drawn in full. */
  get still() {
    return this.full;
  }

  /** Return whether the view is at rest, and shows everything that has arrived. */
  get complete() {
    return this.full && this.content === this.latest;
  }

  /** Return how many points may be drawn. wanted: as the settings say. */
  budget(wanted) {
    return this.full ? wanted : Math.min(wanted, this.most);
  }

  /** Return whether edges are shaded. wanted: as the settings say. */
  shading(wanted) {
    return wanted && (this.full || !this.software);
  }

  /** Take the time between two drawn pictures that moved [ms], and that many points of the last one.
   *
   * Pictures that take several times too long are answered after three of them: twelve take seconds.
   */
  measure(interval, points) {
    this.intervals.push(interval);
    const far = this.intervals.length >= 3 && this.intervals.every((each) => each > 2 * SMOOTH_MS);
    if (this.intervals.length < 12 && !far) return;
    const sorted = this.intervals.sort((one, other) => one - other);
    const slow = sorted[Math.floor(0.75 * sorted.length)];
    this.intervals = [];
    if (slow > SMOOTH_MS) {
      const share = Math.max(0.25, (0.9 * SMOOTH_MS) / slow);
      this.most = Math.max(LEAST_POINTS, Math.min(this.most, points) * share);
    } else if (slow < EASY_MS && this.most < Infinity) this.most *= 1.15;
  }
}
