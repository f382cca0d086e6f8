// Tables are sorted by a click on a heading, in the report and on the documentation's site.
const numberOf = text => { const found = text.match(/^-?[\d.]+(e[-+]?\d+)?/); return found ? found[0] : text; };
for (const head of document.querySelectorAll("th")) {
  const sort = () => {
    const table = head.closest("table"), body = table.tBodies[0];
    const column = [...head.parentNode.children].indexOf(head);
    const down = head.getAttribute("aria-sort") === "ascending";
    for (const other of head.parentNode.children) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", down ? "descending" : "ascending");
    const key = row => row.cells[column].dataset.key ?? numberOf(row.cells[column].textContent.trim());
    const compare = (a, b) => {
      const x = key(a), y = key(b);
      if (x === "" || y === "") return (x === "") - (y === "");  // what is not known goes last
      const order = isNaN(x) || isNaN(y) ? x.localeCompare(y) : Number(x) - Number(y);
      return down ? -order : order;
    };
    body.append(...[...body.rows].sort(compare));
  };
  head.addEventListener("click", sort);
  head.addEventListener("keydown", event => { if (event.key === "Enter") sort(); });
}
// A choice above tables that have a column of this name shows the rows of one of its values.
const COLUMN = "extra input";
for (const table of document.querySelectorAll("table")) {
  const heads = [...(table.tHead?.rows[0]?.cells ?? [])].map(head => head.textContent.trim());
  const column = heads.indexOf(COLUMN);
  if (column < 0) continue;
  const values = [...new Set([...table.tBodies[0].rows].map(row => row.cells[column].textContent.trim()))];
  const choice = document.createElement("select");
  choice.add(new Option(`all methods`, "*"));
  for (const value of values.sort()) choice.add(new Option(value || "places alone", value));
  choice.addEventListener("change", () => {
    for (const row of table.tBodies[0].rows)
      row.hidden = choice.value !== "*" && row.cells[column].textContent.trim() !== choice.value;
  });
  table.before(choice);
}
