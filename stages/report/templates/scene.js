// Open an embedded 4D scene over the report; its page is made only then, so that the report itself stays light.
const scenes = document.getElementById("scene-dialog");
document.querySelectorAll("[data-scene]").forEach((button) => button.addEventListener("click", () => {
  const frame = document.createElement("iframe");
  frame.title = `4D scene ${button.textContent}`;
  frame.srcdoc = JSON.parse(document.getElementById(button.dataset.scene).textContent);
  scenes.append(frame);
  scenes.showModal();
}));
scenes?.addEventListener("close", () => scenes.querySelector("iframe").remove());
