// The page of `nmpm play`: a server has the session.

import { Play } from "./play.js";
import { element, scene, unpack } from "./scene.js";

const MATERIALS = 2;
const socket = new WebSocket(`${location.origin.replace("http", "ws")}${location.pathname}socket`);
const send = (command) => socket.readyState === WebSocket.OPEN && socket.send(JSON.stringify(command));
let taken = Promise.resolve();

async function take(data) {
  if (typeof data === "string") {
    const message = JSON.parse(data);
    if (message.scene) window.play = new Play(send, await unpack(Object.assign(scene, message.scene).obstacles, 1));
    return window.play.read(message);
  }
  const [kind, picture, frame] = new Uint32Array(data, 0, 4);
  if (kind === MATERIALS) window.play.takeMaterials(new Uint8Array(data, 16));
  else window.play.takeFrame(kind, picture, frame, new Uint16Array(data, 16));
}

socket.binaryType = "arraybuffer";
socket.onmessage = ({ data }) => (taken = taken.then(() => take(data)).catch((error) => (element("message").textContent = error.message)));
socket.onclose = ({ reason }) => {
  element("message").textContent = `${reason || "nmpm play has ended"}. Reload the page to play on.`;
  element("message").hidden = false;
};
