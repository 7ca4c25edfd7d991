// Search runs in a worker. A page that is opened as a file may have none, so there a
// hidden frame loads the worker's script, and messages go to and from that frame.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      this.frame = document.createElement("iframe");
      this.frame.hidden = true;
      document.body.append(this.frame);
      const inside = this.frame.contentWindow;
      inside.postMessage = (data) => this.tell(data);
      this.loaded = new Promise((done) => {
        const script = inside.document.createElement("script");
        script.onload = done;
        script.src = new URL(url, location.href).href;
        inside.document.body.append(script);
      });
    }
    postMessage(data) {
      const inside = this.frame.contentWindow;
      const message = new inside.MessageEvent("message", { data });
      this.loaded.then(() => inside.dispatchEvent(message));
    }
    tell(data) {
      const message = new MessageEvent("message", { data });
      setTimeout(() => {
        this.dispatchEvent(message);
        if (this.onmessage) this.onmessage(message);
      });
    }
    terminate() {
      this.frame.remove();
    }
  };
}
