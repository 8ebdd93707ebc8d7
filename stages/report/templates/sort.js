// Click a heading to sort its table; a second click turns the order. Empty cells stay last.
function sortBy(heading) {
  const row = heading.parentElement, table = heading.closest("table"), body = table.tBodies[0];
  const column = [...row.children].indexOf(heading);
  const turn = heading.getAttribute("aria-sort") === "ascending" ? -1 : 1;
  for (const other of row.children) other.removeAttribute("aria-sort");
  heading.setAttribute("aria-sort", turn > 0 ? "ascending" : "descending");
  const key = (line) => line.children[column].dataset.key;
  const compare = (a, b) => {
    if (key(a) === "" || key(b) === "") return (key(a) === "") - (key(b) === "");
    const numbers = [Number(key(a)), Number(key(b))];
    return turn * (numbers.some(Number.isNaN) ? key(a).localeCompare(key(b)) : numbers[0] - numbers[1]);
  };
  body.append(...[...body.rows].sort(compare));
}
document.querySelectorAll("th button").forEach((button) =>
  button.addEventListener("click", () => sortBy(button.parentElement)));
addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((part) => { part.open = true; }));
