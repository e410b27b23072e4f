// Starts the page, or says why it cannot start: a script of the old kind, which even file:// loads.
"use strict";

function fail(message) {
  document.getElementById("status").hidden = false;
  document.getElementById("status").classList.add("failed");
  document.getElementById("status-text").textContent = message;
}

if (location.protocol === "file:") {
  fail("Browsers load this page from a web server only. Any will do, for example: python -m http.server in this folder.");
} else if (typeof DecompressionStream === "undefined" || typeof WebAssembly === "undefined" || !("popover" in HTMLElement.prototype)) {
  fail("This browser is too old for the player: Chrome 114, Firefox 125, Safari 17 or newer can show it.");
  document.getElementById("panel").hidden = true;
} else {
  import("./page.js").then((page) => page.start()).catch((error) => fail(String((error && error.message) || error)));
}
