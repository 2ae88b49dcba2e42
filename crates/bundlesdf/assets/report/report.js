// The timeline's cursor: the numbers of the frame under the pointer, or chosen with the arrow keys.
(() => {
  const plot = document.getElementById("timeline");
  if (!plot) return;
  const frames = JSON.parse(document.getElementById("frames").textContent);
  const cursor = document.getElementById("cursor");
  const readout = document.getElementById("readout");
  const left = Number(plot.dataset.left), right = Number(plot.dataset.right);
  let current = -1;

  function show(index) {
    current = Math.min(Math.max(index, 0), frames.length - 1);
    const [id, status, inliers, agreement, keyframe, [segment, matching, graph, total]] = frames[current];
    const x = left + ((current + 0.5) / frames.length) * (right - left);
    cursor.setAttribute("x1", x);
    cursor.setAttribute("x2", x);
    cursor.setAttribute("visibility", "visible");
    readout.textContent = `Frame ${id}: ${status}${keyframe ? ", keyframe" : ""}, ${inliers} inliers, ` +
      `${Math.round(agreement * 100)} % of the depth agrees, ${total} ms ` +
      `(segmentation ${segment}, matching ${matching}, pose graph ${graph})`;
  }

  plot.tabIndex = 0;
  plot.addEventListener("pointermove", (event) => {
    const box = plot.getBoundingClientRect();
    const x = ((event.clientX - box.left) / box.width) * plot.viewBox.baseVal.width;
    show(Math.floor(((x - left) / (right - left)) * frames.length));
  });
  plot.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!step) return;
    event.preventDefault();
    show(current + step);
  });
})();
