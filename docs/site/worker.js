/* The search runs in a worker, which browsers refuse to pages opened as files: there an invisible frame takes its place. */
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      this.ready = new Promise((resolve) => frame.addEventListener("load", resolve, { once: true }));
      document.body.appendChild(frame);
      const inner = frame.contentDocument;
      frame.contentWindow.__answer = (data) => {
        const event = new MessageEvent("message", { data });
        this.dispatchEvent(event);
        if (this.onmessage) this.onmessage(event);
      };
      inner.open();
      inner.write(
        "<script>window.postMessage = window.__answer;" +
          "window.importScripts = (...urls) => urls.reduce((before, src) => before.then(() => new Promise((done, fail) => {" +
          "const script = document.createElement('script');" +
          "script.src = src; script.onload = done; script.onerror = fail; document.body.appendChild(script); })), Promise.resolve());" +
          "<\/script><body><script src='" + url + "'><\/script></body>",
      );
      inner.close();
      this.frame = frame;
    }
    postMessage(data) {
      this.ready.then(() => this.frame.contentWindow.dispatchEvent(new MessageEvent("message", { data })));
    }
    terminate() {
      this.frame.remove();
    }
  };
}
