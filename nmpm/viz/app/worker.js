// Computes bundles of frames: the exported model, run by ONNX Runtime's WebAssembly on one thread.
// Comes in: {load}, {start}, {throws}; goes out: {ready}, a bundle, or {error}.

const CLEARANCE = 0.75; // least distance of a new particle from others, in spacings
const fromBase64 = (text) => new Float32Array(Uint8Array.from(atob(text), (character) => character.charCodeAt(0)).buffer);
let ort, session, scene, state;

async function read(url, integrity) {
  const answer = await fetch(url, integrity ? { integrity } : {}).catch(() => null);
  if (!answer) throw new Error(`${url} cannot be read, or is not the file that this page expects.`);
  if (!answer.ok) throw new Error(`${url} cannot be read: ${answer.status}.`);
  return answer.arrayBuffer();
}

async function load(described) {
  scene = described;
  const [script, wasm, model] = await Promise.all([
    ...scene.runtime.files.map(([name, integrity]) => read(scene.runtime.folder + name, integrity)), read(scene.model)]);
  ort = await import(URL.createObjectURL(new Blob([script], { type: "text/javascript" })));
  Object.assign(ort.env.wasm, { numThreads: 1, wasmBinary: wasm });
  session = await ort.InferenceSession.create(model, { executionProviders: ["wasm"] });
  return { ready: true };
}

/** Points of a thrown block for which there is room. */
function withRoom(points) {
  const nearest = (CLEARANCE * scene.spacing) ** 2, others = state.position, free = [];
  for (const point of points) {
    let apart = point.every((value, axis) => value >= scene.bounds[axis][0] && value <= scene.bounds[axis][1]);
    for (let i = 0; apart && i < others.length; i += 2)
      apart = (point[0] - others[i]) ** 2 + (point[1] - others[i + 1]) ** 2 >= nearest;
    if (apart) free.push(point);
  }
  return free.slice(0, scene.most - others.length / 2);
}

const joined = (one, other) => Float32Array.from([...one, ...other]);

function put({ points, velocity }) {
  const free = withRoom(points);
  if (!free.length) return;
  state.position = joined(state.position, free.flat());
  state.velocity = joined(state.velocity, free.flatMap(() => velocity));
  state.budget = NaN; // that of the state with the block
}

async function bundle(throws) {
  throws.forEach(put);
  const count = state.position.length / 2, shape = [1, count, 2], started = performance.now();
  const outputs = await session.run({
    position: new ort.Tensor("float32", state.position, shape),
    velocity: new ort.Tensor("float32", state.velocity, shape),
    budget: new ort.Tensor("float32", [state.budget], [1]),
  });
  const milliseconds = performance.now() - started, positions = Float32Array.from(outputs.positions.data);
  if (!positions.every(Number.isFinite)) throw new Error("The model has predicted positions that are no numbers: restart.");
  state.position = positions.slice(-2 * count);
  state.velocity = Float32Array.from(outputs.next_velocity.data);
  state.budget = outputs.next_budget.data[0];
  return { run: state.run, positions, count, milliseconds };
}

let queue = Promise.resolve();
self.onmessage = ({ data }) => {
  queue = queue.then(async () => {
    try {
      if (data.load) self.postMessage(await load(data.load));
      if (data.start) {
        const { run, position, velocity } = data.start;
        state = { run, position: fromBase64(position), velocity: fromBase64(velocity), budget: NaN };
      }
      if (data.throws) self.postMessage(await bundle(data.throws));
    } catch (error) {
      self.postMessage({ error: error.message, run: state?.run });
    }
  });
};
