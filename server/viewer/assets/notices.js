// Messages to the user. Each subject has at most one.

const area = document.getElementById("notices");
const shown = new Map();

/** Show a message about a subject, replacing the one before; without text, remove it. */
export function notify(subject, title, text = "", kind = "", seconds = 0) {
  const before = shown.get(subject);
  const now = `${title}\n${text}\n${kind}`;
  if (before?.now === now) {
    if (seconds) renew(subject, before, seconds);
    return;
  }
  clear(subject);
  const item = document.createElement("div");
  item.className = `notice ${kind}`;
  item.dataset.subject = subject;
  const strong = document.createElement("strong");
  strong.textContent = title;
  item.append(strong, text);
  area.append(item);
  const entry = { item, now, timer: 0 };
  shown.set(subject, entry);
  if (seconds) renew(subject, entry, seconds);
}

/** Remove the message about a subject. */
export function clear(subject) {
  const entry = shown.get(subject);
  if (!entry) return;
  clearTimeout(entry.timer);
  entry.item.remove();
  shown.delete(subject);
}

/** Return the subjects that have a message. */
export function subjects() {
  return [...shown.keys()];
}

function renew(subject, entry, seconds) {
  clearTimeout(entry.timer);
  entry.timer = setTimeout(() => clear(subject), seconds * 1000);
}

/** Cover the page with a message after which nothing else works. */
export function fatal(text) {
  const item = document.createElement("p");
  item.className = "fatal";
  item.setAttribute("role", "alert");
  item.textContent = text;
  document.body.append(item);
}
