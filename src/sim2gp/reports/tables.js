// Each table can be copied as CSV, or is selected where the clipboard is not to be had.
for (const table of document.querySelectorAll(".scroll > table")) {
  const button = document.createElement("button");
  button.className = "copy";
  button.textContent = "copy as CSV";
  const quoted = cell => {
    const text = cell.innerText.trim().replace(/\s+/g, " ");
    return /[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
  };
  button.csv = () => [...table.rows]
    .map(row => [...row.cells].map(quoted).join(",")).join("\n") + "\n";
  button.addEventListener("click", async () => {
    try {
      await navigator.clipboard.writeText(button.csv());
      button.textContent = "copied";
    } catch (refused) {
      getSelection().selectAllChildren(table);
      button.textContent = "selected: copy it";
    }
  });
  table.parentElement.after(button);
}
