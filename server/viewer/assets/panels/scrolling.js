// A hint at the foot of a column of panels that goes on below what is seen.

// Less than this is no panel, but a rest of padding [pixels].
const LITTLE = 16;

/** Show the hint while a column can be scrolled farther. area: the column, with its panels. */
export function hintAtMore(area) {
  const hint = document.createElement("div");
  hint.className = "more";
  hint.textContent = "▾ more below";
  // Browsers scroll by keys and offer all panels in order: the hint is for the eye.
  hint.setAttribute("aria-hidden", "true");
  area.append(hint);
  const look = () => {
    hint.style.visibility = area.scrollHeight - area.scrollTop - area.clientHeight > LITTLE ? "visible" : "hidden";
  };
  area.addEventListener("scroll", look, { passive: true });
  const sizes = new ResizeObserver(look);
  sizes.observe(area);
  for (const section of area.querySelectorAll("section")) sizes.observe(section);
  look();
}
