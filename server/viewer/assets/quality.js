// How much is drawn: as the settings say when nothing moves, and as much as stays smooth when it does.
//
// A picture that did not change is not drawn again. Where graphics are computed in software, a moving
// picture has fewer points than a still one.

const SMOOTH_MS = 42, EASY_MS = 24;
const LEAST_POINTS = 25e3, FIRST_SOFTWARE = 60e3;
// Our own drawing begins with this many points, of which about 200,000 are in reach of the picture. They are
// fewer if pictures take longer than `SMOOTH_MS` and their points more than `OWN_MS` of it, and more again if
// their points take less than a share of it, which is smaller once they are as many as at the beginning. Other
// work on the machine makes pictures late, too, against which fewer points are little help: the least
// disturbed pictures count. Fewer points are larger and cover as much: 60 % of them take 80 % of the time.
const FIRST_OWN = 240e3, LEAST_OWN = 120e3, OWN_MS = 18, AGAIN = 0.75, MORE = 0.5;
// Mean time between our own pictures, at least [ms]: a server has 30 states a second, and the processor serves
// it, too. After a late picture the next one may come at the least time [ms].
const OWN_INTERVAL_MS = 32, OWN_LEAST_MS = 15;
// A view that has not changed for this long is drawn in full [ms]. While the user asks to move, a full
// picture would delay the next ones: who pushes against a wall, and does not move, waits longer for it.
const STILL_MS = 240, PUSHING_MS = 1000;
// A full picture takes a second in WebGL, and a tenth of a second in our own drawing [ms].
const GATHERED_MS = 1500, GATHERED_OWN_MS = 400;

export class Quality {
  /** software: whether there is no graphics processor.  own: whether raster/ draws. */
  constructor(software, own) {
    this.software = software;
    this.own = own;
    this.most = own ? FIRST_OWN : software ? FIRST_SOFTWARE : Infinity;
    this.gathered = own ? GATHERED_OWN_MS : GATHERED_MS;
    this.intervals = [];
    this.works = [];
    this.seen = "";
    this.chosen = "";
    this.content = "";
    this.latest = "";
    this.changed = 0;
    this.drawn = 0;
    this.due = 0;
    this.full = false;
  }

  /** Return whether it is too early for another picture. now: [ms]. */
  early(now) {
    return this.own && now < this.due;
  }

  /** Note that a picture is drawn. now: [ms]. */
  draws(now) {
    this.due = Math.max(this.due + OWN_INTERVAL_MS, now + OWN_LEAST_MS);
  }

  /** Note what a picture depends on. Returns whether the picture must be drawn.
   *
   * seen: text of the camera and all that moves.  chosen: text of settings.  content: text of the
   * scan that has arrived.  now: [ms].  asked: whether the user is asking to move.
   */
  look(seen, chosen, content, now, asked) {
    this.latest = content;
    if (seen !== this.seen) {
      Object.assign(this, { seen, chosen, content, changed: now, full: false });
      return true;
    }
    if (chosen !== this.chosen) {
      Object.assign(this, { chosen, content, drawn: now });
      return true;
    }
    // In software a full picture takes long: new tiles are gathered.
    if (content !== this.content && (!this.software || !this.full || now - this.drawn > this.gathered)) {
      Object.assign(this, { content, drawn: now });
      return true;
    }
    if (this.full || now - this.changed < (asked ? PUSHING_MS : STILL_MS)) return false;
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

  /** Return how many points may be drawn. wanted: as the settings say.  spread: points of tiles for each one that takes time. */
  budget(wanted, spread = 1) {
    return this.full ? wanted : Math.min(wanted, spread * this.most);
  }

  /** Return whether edges are shaded. wanted: as the settings say. */
  shading(wanted) {
    return wanted && (this.full || !this.software);
  }

  /** Take the time between two drawn pictures that moved [ms], and that many points of the last one.
   *
   * work: time that points took in our own drawing [ms].  Pictures that take several times too long are
   * answered after three of them: twelve take seconds.
   */
  measure(interval, points, work) {
    this.intervals.push(interval);
    this.works.push(work);
    const far = this.intervals.length >= 3 && this.intervals.every((each) => each > 2 * SMOOTH_MS);
    if (this.intervals.length < 12 && !far) return;
    const ordered = [this.intervals, this.works].map((all) => all.sort((one, other) => one - other));
    const slow = ordered[0][Math.floor(0.75 * this.intervals.length)], long = ordered[1][Math.floor(0.25 * this.works.length)];
    this.intervals = [];
    this.works = [];
    if (this.own) this.regulate(slow, long, points);
    else if (slow > SMOOTH_MS) {
      const share = Math.max(0.25, (0.9 * SMOOTH_MS) / slow);
      this.most = Math.max(LEAST_POINTS, Math.min(this.most, points) * share);
    } else if (slow < EASY_MS && this.most < Infinity) this.most *= 1.15;
  }

  /** Change the number of points of our own drawing. long: time that they took [ms]. */
  regulate(slow, long, points) {
    if (slow > SMOOTH_MS && long > OWN_MS) {
      this.most = Math.max(LEAST_OWN, Math.min(this.most, points) * Math.max(0.5, OWN_MS / long));
    } else if (long < OWN_MS * (this.most < FIRST_OWN ? AGAIN : MORE)) this.most = Math.min(1.15 * this.most, 2 * FIRST_OWN);
  }
}
