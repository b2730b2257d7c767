// The WebSocket to the process of the viewer: connects, and connects again.

import { VERSION, decode } from "./messages.js";

const RETRY_MS = 1000;

export class Link {
  /** handlers: functions by type of message.  changed: called with whether the process is connected. */
  constructor(at, handlers, changed) {
    this.at = at;
    this.handlers = handlers;
    this.changed = changed;
    this.socket = null;
    this.reason = "";
    this.connect();
  }

  connect() {
    const socket = new WebSocket(`ws://${location.host}/socket`);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.socket = socket;
      this.send({ type: "hello", version: VERSION, at: this.at });
      this.changed(true, "");
    };
    socket.onmessage = ({ data }) => {
      const message = typeof data === "string" ? JSON.parse(data) : decode(data);
      this.handlers[message.type]?.(message);
    };
    socket.onclose = ({ reason }) => {
      this.socket = null;
      this.changed(false, reason);
      setTimeout(() => this.connect(), RETRY_MS);
    };
  }

  get open() {
    return this.socket !== null && this.socket.readyState === WebSocket.OPEN;
  }

  send(message) {
    if (this.open) this.socket.send(JSON.stringify(message));
  }
}
