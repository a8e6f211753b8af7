// How different neighbours look in frames, as the page finds it: node structure.mjs PAGE < JOB.json
import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

globalThis.navigator ??= {};
const { structure } = await import(pathToFileURL(`${process.argv[2]}/data.js`));
const { frames, shape, points, positions, surfaces } = JSON.parse(readFileSync(0));
console.log(JSON.stringify(frames.map((values) => structure({ values: values.map((one) => one ?? NaN), shape }, { points, colours: { positions } }, surfaces))));
