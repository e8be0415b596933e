// Saving what is shown: a picture (PNG), or all frames as a film (WebM) or an animation (GIF).

import { Gif } from "./gif.js";
import { css, element, make, scene } from "./scene.js";

const HEAD = 30; // pixels above the panels, for the title
const GIF_WIDTH = 720, GIF_PICTURES = 250, GIF_RATE = 25; // at most so many pixels, pictures, and pictures per second

/** Hands a file over to the browser's downloads. */
function download(blob, suffix) {
  const name = scene.title.replace(/[^\p{L}\p{N}]+/gu, "-").replace(/^-|-$/g, "");
  const link = make("a", { href: URL.createObjectURL(blob), download: `${name}.${suffix}` });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

/** Draws title, panels, their labels and the frame's number on a canvas. */
function compose(viewer, canvas) {
  const shown = element("scene"), ratio = shown.width / shown.clientWidth, context = canvas.getContext("2d");
  const [width, height] = [shown.width & ~1, (shown.height + HEAD * ratio) & ~1]; // even, as films need
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.fillStyle = css(viewer.theme.page);
  context.fillRect(0, 0, width, height);
  context.drawImage(shown, 0, HEAD, shown.clientWidth, shown.clientHeight);
  context.fillStyle = css(viewer.theme.text);
  context.font = "600 14px system-ui, sans-serif";
  context.textAlign = "center";
  for (const label of element("labels").children)
    context.fillText(label.textContent, parseFloat(label.style.left), HEAD + parseFloat(label.style.top) + 16, parseFloat(label.style.maxWidth));
  context.textAlign = "left";
  context.fillText(scene.title, 12, 20, shown.clientWidth - 150);
  context.font = "13px system-ui, sans-serif";
  context.textAlign = "right";
  context.fillText(element("time").textContent.split(", ").at(-1), shown.clientWidth - 12, 20);
}

export function savePicture(viewer) {
  const canvas = document.createElement("canvas");
  viewer.draw(); // the drawing is lost when the browser has shown it
  compose(viewer, canvas);
  canvas.toBlob((blob) => download(blob, "png"));
}

/** Plays from the first frame to the last and records what is seen; once more ends it early. */
export function saveFilm(viewer) {
  if (viewer.recorder) return viewer.recorder.stop();
  const canvas = document.createElement("canvas"), parts = [], button = element("film");
  viewer.stopAt(0);
  viewer.draw();
  compose(viewer, canvas);
  const type = ["video/webm;codecs=vp9", "video/webm", "video/mp4"].find((each) => window.MediaRecorder?.isTypeSupported(each));
  if (!type) return viewer.say("This browser records no films: nmpm render writes them.");
  const recorder = new MediaRecorder(canvas.captureStream(), { mimeType: type, videoBitsPerSecond: 8e6 });
  recorder.ondataavailable = ({ data }) => parts.push(data);
  recorder.onstop = () => {
    viewer.recorder = viewer.onDrawn = null;
    button.classList.remove("recording");
    download(new Blob(parts, { type }), type.includes("mp4") ? "mp4" : "webm");
  };
  let last = 0;
  viewer.onDrawn = () => {
    if (viewer.frame < last || !viewer.playing) return recorder.state === "recording" && recorder.stop();
    last = viewer.frame;
    compose(viewer, canvas);
  };
  viewer.recorder = recorder;
  button.classList.add("recording");
  recorder.start();
  viewer.toggle();
}

/** All frames as a GIF, at the chosen speed; once more ends it early. */
export async function saveGif(viewer) {
  if (viewer.animating) return (viewer.animating = false);
  const canvas = document.createElement("canvas"), small = document.createElement("canvas");
  const every = Math.ceil(Math.max(viewer.rate / GIF_RATE, viewer.frames / GIF_PICTURES)), last = viewer.frame;
  let gif, context;
  viewer.animating = true;
  element("gif").classList.add("recording");
  for (let frame = 0; frame < viewer.frames && viewer.animating; frame += every) {
    viewer.stopAt(frame);
    viewer.draw();
    compose(viewer, canvas);
    if (!gif) {
      const scale = Math.min(1, GIF_WIDTH / canvas.width);
      [small.width, small.height] = [canvas.width, canvas.height].map((length) => Math.round(length * scale));
      [gif, context] = [new Gif(small.width, small.height), small.getContext("2d", { willReadFrequently: true })];
    }
    context.drawImage(canvas, 0, 0, small.width, small.height);
    gif.add(context.getImageData(0, 0, small.width, small.height).data, Math.max(2, Math.round((100 * every) / viewer.rate)));
    await new Promise((resolve) => setTimeout(resolve));
  }
  viewer.animating = false;
  element("gif").classList.remove("recording");
  viewer.stopAt(last);
  download(gif.blob(), "gif");
}
