// A page that is opened as a file may not start a worker, so the worker of the search runs in a hidden
// frame in its place. On a web server, this file does nothing.
if (location.protocol === "file:") {
  window.IFrameWorker = window.Worker = class extends EventTarget {
    constructor(address) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.body.append(frame);
      this.scope = frame.contentWindow;
      const inside = this.scope.document;
      inside.open();
      this.scope.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
      inside.write(`<script src="${address}"></` + "script>");
      this.isReady = new Promise((resolve) => frame.addEventListener("load", resolve, { once: true }));
      inside.close();
    }
    postMessage(data) {
      this.isReady.then(() => this.scope.dispatchEvent(new MessageEvent("message", { data })));
    }
    terminate() {
      this.scope.frameElement.remove();
    }
  };
}
