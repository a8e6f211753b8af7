// Scenes in and out: JSON, PNGs of `fhash render`, links.

const SCENE_KEY = "fhash.scene";
const MOST_SCENE = 2 ** 20;

/** The scene of a dropped JSON or PNG; null for any other file. */
export async function readFile(file) {
  const name = file.name.toLowerCase();
  if (name.endsWith(".json")) {
    if (file.size > MOST_SCENE) throw new Error("is too large for a scene");
    try {
      return checked(JSON.parse(await file.text()));
    } catch (error) {
      throw new Error(`is no scene: ${error.message}`);
    }
  }
  if (name.endsWith(".png")) return sceneOfPng(new Uint8Array(await file.arrayBuffer()));
  if (name.endsWith(".toml")) throw new Error("scenes in TOML are read by fhash render alone; save it as JSON there");
  return null;
}

function checked(scene) {
  if (scene === null || typeof scene !== "object" || Array.isArray(scene)) throw new Error("it is no JSON object");
  return withoutNulls(scene);
}

/** `null` stands for what is left out; `true` for the defaults of an effect. */
function withoutNulls(given) {
  if (Array.isArray(given) || given === null || typeof given !== "object") return given;
  return Object.fromEntries(Object.entries(given).filter(([, one]) => one !== null).map(([key, one]) => [key, withoutNulls(one)]));
}

async function sceneOfPng(data) {
  const view = new DataView(data.buffer), latin = (from, to) => String.fromCharCode(...data.subarray(from, to));
  if (latin(1, 4) !== "PNG") throw new Error("is no PNG");
  for (let at = 8; at + 12 <= data.length;) {
    const length = view.getUint32(at), kind = latin(at + 4, at + 8), body = data.subarray(at + 8, at + 8 + length);
    if (kind === "iTXt" && latin(at + 8, at + 8 + SCENE_KEY.length) === SCENE_KEY) {
      const packed = body[SCENE_KEY.length + 1] === 1, language = body.indexOf(0, SCENE_KEY.length + 3);
      let text = body.subarray(body.indexOf(0, language + 1) + 1);
      if (packed) text = new Uint8Array(await new Response(new Blob([text]).stream().pipeThrough(new DecompressionStream("deflate"))).arrayBuffer());
      return checked(JSON.parse(new TextDecoder().decode(text)));
    }
    at += 12 + length;
  }
  throw new Error("holds no scene; only pictures of fhash render and of this page do");
}

export const sceneFile = (scene) => new Blob([JSON.stringify(scene, null, 1) + "\n"], { type: "application/json" });

/** A PNG of a canvas that holds its scene as pictures of `fhash render` do. */
export async function pictureWithScene(canvas, scene) {
  const blob = await new Promise((resolve) => canvas.toBlob(resolve, "image/png")), data = new Uint8Array(await blob.arrayBuffer());
  const body = new TextEncoder().encode(`iTXt${SCENE_KEY}\0\0\0\0\0${JSON.stringify(scene)}`), chunk = new Uint8Array(body.length + 8);
  new DataView(chunk.buffer).setUint32(0, body.length - 4);
  chunk.set(body, 4);
  new DataView(chunk.buffer).setUint32(body.length + 4, crc32(body));
  return new Blob([data.subarray(0, 33), chunk, data.subarray(33)], { type: "image/png" });
}

function crc32(data) {
  let crc = ~0;
  for (const byte of data) {
    crc ^= byte;
    for (let bit = 0; bit < 8; bit++) crc = (crc >>> 1) ^ (crc & 1 ? 0xedb88320 : 0);
  }
  return ~crc >>> 0;
}

/** Give a file to the user. */
export function saveBlob(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

export const hashOf = (state) => "#" + encodeURIComponent(JSON.stringify(state)).replace(/%(22|2C|3A|7B|7D|5B|5D)/g, (_, code) => String.fromCharCode(parseInt(code, 16)));

/** What a link holds; nothing where it is none of ours. */
export function stateOfHash(hash) {
  try {
    const state = JSON.parse(decodeURIComponent(hash.slice(1)));
    return state && typeof state === "object" ? { ...state, scene: state.scene && checked(state.scene) } : {};
  } catch {
    return {};
  }
}
