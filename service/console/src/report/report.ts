// The report's only script: moves the edge between two pictures. Without it both are there, one below the other.
for (const figure of document.querySelectorAll<HTMLElement>("figure.pair")) {
  const input = document.createElement("input");
  input.type = "range";
  input.min = "0";
  input.max = "100";
  input.value = "50";
  input.setAttribute("aria-label", "edge between before and after, in percent of the width");
  const move = (): void => figure.style.setProperty("--edge", `${input.value}%`);
  input.addEventListener("input", move);
  figure.classList.add("stacked");
  figure.append(input);
  move();
}
