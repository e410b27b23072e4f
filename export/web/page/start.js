// Starts the page, or says why it cannot start: a script of the old kind, which even file:// loads.
"use strict";

function fail(message) {
  document.getElementById("status").hidden = false;
  document.getElementById("status").classList.add("failed");
  document.getElementById("status-text").textContent = message;
}

if (location.protocol === "file:") {
  fail("Browsers load this page from a web server only. Any will do, for example: python -m http.server in this folder.");
} else if (typeof DecompressionStream === "undefined" || typeof WebAssembly === "undefined") {
  fail("This browser is too old for the player: it needs WebAssembly and DecompressionStream (2023 or newer).");
} else {
  import("./page.js").then((page) => page.start()).catch((error) => fail(String((error && error.message) || error)));
}
