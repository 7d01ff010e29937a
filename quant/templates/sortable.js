// Every heading with data-sort becomes a button that sorts the rows by their cells' data-value.
function sortable(table) {
  const body = table.tBodies[0], rows = [...body.rows], heads = [...table.tHead.rows[0].cells];

  function value(row, column, kind) {
    const text = row.cells[column].dataset.value;
    return kind === "number" ? (text === "" ? null : Number(text)) : text;
  }
  // What nobody knows comes last, whichever way.
  function compare(a, b, way) {
    if (a === null || b === null) return (a === null) - (b === null);
    return way * (typeof a === "string" ? a.localeCompare(b, "en", {numeric: true}) : a - b);
  }
  function sort(column) {
    const head = heads[column], way = head.getAttribute("aria-sort") === "ascending" ? -1 : 1;
    const kind = head.dataset.sort;
    heads.forEach(each => each.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", way > 0 ? "ascending" : "descending");
    rows.sort((a, b) => compare(value(a, column, kind), value(b, column, kind), way));
    body.append(...rows);
  }
  heads.forEach((head, column) => {
    if (!head.dataset.sort) return;
    const button = document.createElement("button");
    button.type = "button";
    button.append(...head.childNodes);
    head.append(button);
    button.addEventListener("click", () => sort(column));
  });
}
