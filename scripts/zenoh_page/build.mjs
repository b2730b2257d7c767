// Bundle the page into dist/: index.html and page.js, which load nothing else.

import { copyFile, readFile } from "node:fs/promises";
import { basename } from "node:path";
import { build } from "esbuild";

// zenoh-ts imports a WebAssembly module as if it were JavaScript, which browsers do not load yet. Its
// bytes are put into the bundle, instantiated with the module of imports that lies beside it.
const wasm = {
  name: "wasm",
  setup({ onLoad }) {
    onLoad({ filter: /\.wasm$/ }, async ({ path }) => {
      const bytes = await readFile(path);
      const module = new WebAssembly.Module(bytes);
      const from = [...new Set(WebAssembly.Module.imports(module).map((each) => each.module))];
      const names = WebAssembly.Module.exports(module).map((each) => each.name);
      return {
        loader: "js",
        resolveDir: path.slice(0, -basename(path).length),
        contents: [
          ...from.map((each, k) => `import * as from${k} from ${JSON.stringify(each)};`),
          `const bytes = Uint8Array.from(atob("${bytes.toString("base64")}"), (each) => each.charCodeAt(0));`,
          `const imports = { ${from.map((each, k) => `${JSON.stringify(each)}: from${k}`).join(", ")} };`,
          "const { instance } = await WebAssembly.instantiate(bytes, imports);",
          `export const { ${names.join(", ")} } = instance.exports;`,
        ].join("\n"),
      };
    });
  },
};

const here = (path) => new URL(path, import.meta.url).pathname;
const dist = process.argv[2] ?? here("dist");
await build({
  entryPoints: [here("src/page.js")],
  outfile: `${dist}/page.js`,
  bundle: true,
  format: "esm",
  target: "es2022",
  minify: true,
  legalComments: "linked",
  plugins: [wasm],
});
await copyFile(here("index.html"), `${dist}/index.html`);
