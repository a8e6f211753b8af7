// Colour maps of fhash (rendering/colour_maps.py; a test compares them): colours 'rrggbb' from the lowest value up.
export const MAPS = {
  viridis: "440154 471163 481f71 472d7b 443a83 404688 3b528b 355d8d 31688e 2c728e 287c8e 24868e 21908c 1f9a8a 20a486 28ae80 35b779 47c06f 5dc963 75d054 8fd744 abdc32 c7e020 e3e418 fde725",
  plasma: "0d0887 220690 310596 3f049c 4c02a1 5901a5 6600a7 7201a8 7e03a8 8909a6 9511a2 9f1a9c a92396 b22c8e bb3587 c33e80 cb4778 d25071 d9596a e06263 e66c5c eb7555 f07f4f f48a48 f89441 fb9f3a fdab33 feb72d fdc328 fcd025 f9dd25 f5eb27 f0f921",
  inferno: "000004 040312 0b0724 150b37 210c4a 2e0a5a 3c0965 4a0c6b 57106d 63146e 70196e 7d1e6d 89226a 962766 a32b61 af315c bb3755 c63e4d d14644 db4f3b e35932 eb6528 f1711e f67f14 f98d0a fb9c06 fcab0f fbba1f f9ca32 f5d949 f2e865 f3f586 fcffa4",
  magma: "000004 050417 100c2d 1d1146 2d1160 3f0f73 50127c 611980 721f81 822681 932b80 a4317e b63779 c73d73 d7456c e65163 f1605d f8735c fb8761 fd9b6b feaf78 fec387 fed698 fde9ab fcfdbf",
  cividis: "00224e 00285b 002e6a 043371 1a386f 273e6e 32436d 3b496c 434e6c 4b546c 52596d 5a5f6e 61656f 686a71 6f7073 757676 7c7b78 848179 8b8778 938d78 9b9376 a39a75 aba072 b3a670 bbad6c c3b469 ccba64 d4c15f ddc958 e6d051 efd748 f8df3c fee838",
  turbo: "30123b 392a73 4040a1 4456c7 466be3 467ff6 4293ff 37a7fa 29bbec 1dcdd8 18dcc3 1ee8b0 31f299 4cf97e 6bfd64 8aff4d a3fd3c b8f735 cced34 dee037 edd03a f8c03a fdae35 fe982c fb8022 f56817 ec520f e04009 d23105 c02302 ac1701 950d01 7a0403",
  coolwarm: "3b4cc0 445acc 4d68d7 5775e1 6282ea 6c8ef1 779af7 82a5fb 8db0fe 98b9ff a3c2ff aec9fd b8d0f9 c2d5f4 ccd9ee d5dbe6 dddddd e5d8d1 ecd3c5 f1ccb9 f4c4ad f7bba0 f7b194 f7a687 f49a7b f18d6f ec7f63 e57058 de604d d55042 cb3e38 c0282f b40426",
  grey: "000000 ffffff",
  rainbow: "8000ff 6032fe 4062fa 208ef4 00b4ec 20d4e1 40ecd4 60fac5 80ffb4 9ffaa2 bfec8e dfd478 ffb462 ff8e4a ff6232 ff3219 ff0000",
  hot: "0b0000 200000 340000 490000 5e0000 730000 880000 9d0000 b20000 c70000 dc0000 f10000 ff0700 ff1c00 ff3000 ff4500 ff5a00 ff6f00 ff8400 ff9900 ffae00 ffc300 ffd800 ffed00 ffff04 ffff23 ffff43 ffff62 ffff81 ffffa1 ffffc0 ffffe0 ffffff",
  bone: "000000 1c1c27 38384e 545574 707b8f 8ba1ab a8c7c7 d3e3e3 ffffff",
  copper: "000000 140c08 271910 3b2518 4f3220 623e28 764b30 8a5738 9d643f b17047 c57d4f d98957 ec955f ffa267 ffae6f ffbb77 ffc77f",
  blues: "f7fbff deebf7 c6dbef 9ecae1 6baed6 4292c6 2171b5 08519c 08306b",
  greens: "f7fcf5 e5f5e0 c7e9c0 a1d99b 74c476 41ab5d 238b45 006d2c 00441b",
  reds: "fff5f0 fee0d2 fcbba1 fc9272 fb6a4a ef3b2c cb181d a50f15 67000d",
  ylgnbu: "ffffd9 edf8b1 c7e9b4 7fcdbb 41b6c4 1d91c0 225ea8 253494 081d58",
  spectral: "9e0142 d53e4f f46d43 fdae61 fee08b ffffbf e6f598 abdda4 66c2a5 3288bd 5e4fa2",
  rdbu: "67001f b2182b d6604d f4a582 fddbc7 f7f7f7 d1e5f0 92c5de 4393c3 2166ac 053061",
  twilight: "e2d9e2 d6d7dd c3ced4 abc2cc 94b4c7 81a6c3 7297c1 6886be 6275ba 5f63b5 5e51ad 5d3da1 592a8f 521b77 45135c 381146 2f1437 3a113a 4b1342 5f174a 741e4f 872750 983550 a64550 b25652 bb6858 c27c62 c78f72 cca388 d1b5a2 d8c6bd ded3d5 e2d9e2",
  ocean: "008000 00700b 006015 005020 00402a 003035 002040 00104a 000055 001060 00206a 003075 004080 00508a 006095 00709f 0080aa 208fb5 409fbf 60afca 7fbfd4 9fcfdf bfdfea dfeff4 ffffff",
  balance: "1b4f8c 4a86c0 9cc3df f7f7f5 f1b08a d1604b 93202c",
  jet: "000080 0000ff 0080ff 00ffff 80ff80 ffff00 ff8000 ff0000 800000",
};

/** Name of a map as MAPS has it, without the suffix `_r` that reverses it; null for an unknown one. */
export function mapKey(name) {
  const key = String(name).toLowerCase().replace(/_r$/, "").replace("gray", "grey");
  return Object.hasOwn(MAPS, key) ? key : null;
}

/** Red, green and blue, 0..1, of '#rrggbb', '#rgb' or a name of CSS; null for anything else. */
export function parseColour(text) {
  const probe = parseColour.probe ??= document.createElement("canvas").getContext("2d");
  probe.fillStyle = "#000001";
  probe.fillStyle = String(text);
  const code = probe.fillStyle;
  if (!/^#[0-9a-f]{6}$/.test(code) || (code === "#000001" && text !== "#000001")) return null;
  return [1, 3, 5].map((at) => parseInt(code.slice(at, at + 2), 16) / 255);
}

/** '#rrggbb' of red, green and blue, 0..1. */
export const colourCode = (rgb) =>
  "#" + rgb.map((c) => Math.round(255 * Math.min(Math.max(c, 0), 1)).toString(16).padStart(2, "0")).join("");

/** Colour map of a scene's `colours` over `range`: positions ascending and points [r, g, b], 0..1. */
export function colourMap(colours, range) {
  if (Array.isArray(colours)) {
    return { positions: colours.map((row) => row[0]), points: colours.map((row) => parseColour(row[1]) ?? [0, 0, 0]) };
  }
  const points = MAPS[mapKey(colours) ?? "viridis"].split(" ").map((code) => parseColour("#" + code));
  if (/_r$/i.test(colours)) points.reverse();
  const last = points.length - 1;
  return { positions: points.map((_, n) => range[0] * (1 - n / last) + range[1] * (n / last)), points };
}

/** Colour [r, g, b] of a value; beyond the ends that of the end. */
export function colourAt(map, value) {
  const { positions, points } = map;
  let n = 0;
  while (n < positions.length - 2 && value >= positions[n + 1]) n++;
  if (positions.length === 1 || !(value > positions[0])) return points[0];
  if (value >= positions.at(-1)) return points.at(-1);
  const width = positions[n + 1] - positions[n];
  const share = width > 0 ? Math.min(Math.max((value - positions[n]) / width, 0), 1) : 0;
  return points[n].map((c, k) => c + share * (points[n + 1][k] - c));
}
