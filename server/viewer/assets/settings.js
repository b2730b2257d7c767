// Settings of the page, kept in the browser, and what depends on them.

const KEY = "solidcloud.settings";

const DEFAULTS = {
  colour: "auto", pointSize: 1, budget: 0.7, shading: true, firstPerson: false,
  contacts: true, clearance: true, boxes: false, near: 0.02, panel: true,
  instruments: false, openPlots: true, openEffects: false, openAccuracy: false, openHierarchy: false,
  tolerance: 3, spheres: true, level: 4, walked: false,
};

const listeners = new Map();
const values = { ...DEFAULTS, ...stored() };

function stored() {
  try {
    const found = JSON.parse(localStorage.getItem(KEY) ?? "{}");
    return Object.fromEntries(
      Object.entries(found).filter(([name, value]) => typeof value === typeof DEFAULTS[name]));
  } catch {
    return {};
  }
}

export const settings = {
  get: (name) => values[name],

  /** Set a value and call its listeners. */
  set(name, value) {
    if (values[name] === value) return;
    values[name] = value;
    try {
      localStorage.setItem(KEY, JSON.stringify(values));
    } catch { /* a browser that stores nothing still shows the scene */ }
    for (const listener of listeners.get(name) ?? []) listener(value);
  },

  toggle(name) {
    settings.set(name, !values[name]);
  },

  /** Call a function with the present value and with each later one. */
  follow(name, listener) {
    listeners.set(name, [...(listeners.get(name) ?? []), listener]);
    listener(values[name]);
  },
};
