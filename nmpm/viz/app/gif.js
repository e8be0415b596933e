// Animations as GIF89a: each frame with its 256 commonest colours, its pixels packed by LZW.

const [CLEAR, END, MOST_CODES, MOST_BITS] = [256, 257, 4096, 12];
const BUCKETS = 32 ** 3; // colours are counted with 5 bits for each of red, green and blue

/** Colours of RGBA pixels, 256 × RGB, and the index of each pixel's colour. */
function indexColours(pixels) {
  const count = pixels.length / 4, buckets = new Uint16Array(count), counts = new Uint32Array(BUCKETS);
  const sums = [0, 1, 2].map(() => new Float64Array(BUCKETS));
  for (let i = 0; i < count; i++) {
    const [r, g, b] = [pixels[4 * i], pixels[4 * i + 1], pixels[4 * i + 2]], bucket = ((r >> 3) << 10) | ((g >> 3) << 5) | (b >> 3);
    buckets[i] = bucket;
    counts[bucket]++;
    sums[0][bucket] += r;
    sums[1][bucket] += g;
    sums[2][bucket] += b;
  }
  const used = [...counts.keys()].filter((bucket) => counts[bucket]).sort((a, b) => counts[b] - counts[a]);
  const means = used.map((bucket) => sums.map((sum) => Math.round(sum[bucket] / counts[bucket])));
  const palette = means.slice(0, 256), slots = new Uint8Array(BUCKETS), colours = new Uint8Array(3 * 256);
  const distance = ([r, g, b], [s, h, c]) => (r - s) ** 2 + (g - h) ** 2 + (b - c) ** 2;
  const nearest = (colour) => palette.reduce((best, other, i) => (distance(other, colour) < distance(palette[best], colour) ? i : best), 0);
  used.forEach((bucket, i) => (slots[bucket] = i < palette.length ? i : nearest(means[i])));
  palette.forEach((colour, i) => colours.set(colour, 3 * i));
  return { colours, indices: buckets.map((bucket) => slots[bucket]) };
}

/** Indices packed by LZW, as blocks of up to 255 bytes. */
function packIndices(indices) {
  const bytes = [], known = new Uint16Array(MOST_CODES * 256);
  let width = 9, next = END + 1, held = 0, bits = 0, prefix = indices[0];
  const put = (code) => {
    held |= code << bits;
    for (bits += width; bits >= 8; bits -= 8, held >>>= 8) bytes.push(held & 255);
    if (next === 1 << width && width < MOST_BITS) width++;
  };
  put(CLEAR);
  for (let i = 1; i < indices.length; i++) {
    const pair = (prefix << 8) | indices[i];
    if (known[pair]) prefix = known[pair];
    else {
      put(prefix);
      if (next < MOST_CODES) known[pair] = next++;
      else {
        put(CLEAR);
        known.fill(0);
        [width, next] = [9, END + 1];
      }
      prefix = indices[i];
    }
  }
  put(prefix);
  put(END);
  if (bits) bytes.push(held);
  const blocks = [8];
  for (let at = 0; at < bytes.length; at += 255) blocks.push(Math.min(255, bytes.length - at), ...bytes.slice(at, at + 255));
  return Uint8Array.from([...blocks, 0]);
}

const twoBytes = (number) => [number & 255, number >> 8];
const textBytes = (text) => [...text].map((letter) => letter.charCodeAt(0));

/** An animation that is played again and again, frame by frame. */
export class Gif {
  constructor(width, height) {
    this.size = [...twoBytes(width), ...twoBytes(height)];
    const again = [0x21, 0xff, 11, ...textBytes("NETSCAPE2.0"), 3, 1, 0, 0, 0];
    this.parts = [Uint8Array.from([...textBytes("GIF89a"), ...this.size, 0x70, 0, 0, ...again])];
  }

  /** Adds RGBA pixels, shown for so many hundredths of a second. */
  add(pixels, hundredths) {
    const { colours, indices } = indexColours(pixels);
    const head = [0x21, 0xf9, 4, 4, ...twoBytes(hundredths), 0, 0, 0x2c, 0, 0, 0, 0, ...this.size, 0x87];
    this.parts.push(Uint8Array.from(head), colours, packIndices(indices));
  }

  blob() { return new Blob([...this.parts, Uint8Array.of(0x3b)], { type: "image/gif" }); }
}
