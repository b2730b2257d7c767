// A client of solidcloud over zenoh's remote API.

import { Config, Duration, LivelinessToken, ReplyError, Session } from "@eclipse-zenoh/zenoh-ts";
import {
  ENCODING, addAvatarRequest, collideRequest, newClient, questionKey, readAvatarInfo, readCollideAnswers, readError,
  readSceneInfo, tokenKey,
} from "./wire.js";

// A server ends a request after 2 s unless configured otherwise.
const ANSWER_SECONDS = 10;
// The bridge answers a message within this time [ms].
const BRIDGE_MS = 5000;
const AVATAR = "figure";

export class Client {
  /** @param {Session} session @param {string} scene */
  constructor(session, scene) {
    this.session = session;
    this.scene = scene;
    // Whoever knows it can act in this client's name.
    this.client = newClient();
    /** @type {LivelinessToken | null} */
    this.token = null;
  }

  /**
   * Open a session at a bridge. Throws if nothing answers there.
   * @param {string} bridge address of its WebSocket, for example ws://127.0.0.1:10000
   * @param {string} scene
   */
  static async open(bridge, scene) {
    await answers(bridge);
    const client = new Client(await Session.open(new Config(bridge, BRIDGE_MS)), scene);
    // Without a token, the server drops the avatar after a minute.
    client.token = await client.session.liveliness().declareToken(tokenKey(scene, client.client));
    return client;
  }

  /** Return SceneInfo, or null if no server replies. */
  async info() {
    const answer = await this.ask("info", null);
    return answer === null ? null : readSceneInfo(answer);
  }

  /** Add the figure. Returns AvatarInfo, or null if no server replies. @param {number[][]} points @param {number} radius */
  async addFigure(points, radius) {
    const answer = await this.ask("add_avatar", addAvatarRequest(AVATAR, points, radius));
    return answer === null ? null : readAvatarInfo(answer);
  }

  /** Return CollideAnswers of poses, or null if no server replies: then all is unknown. @param {number[][][]} poses */
  async collide(poses) {
    const answer = await this.ask("collide", collideRequest(AVATAR, poses));
    return answer === null ? null : readCollideAnswers(answer, poses.length);
  }

  /**
   * Return the text of the answer to a question, or null without a reply. Throws the server's error.
   * @param {string} question @param {string | null} payload
   */
  async ask(question, payload) {
    const receiver = await this.session.get(questionKey(this.scene, this.client, question), {
      encoding: ENCODING, timeout: Duration.seconds.of(ANSWER_SECONDS), ...(payload === null ? {} : { payload }),
    });
    if (!receiver) return null;
    for await (const reply of receiver) {
      const result = reply.result();
      if (!(result instanceof ReplyError)) return result.payload().toString();
      const error = readError(result.encoding().toString(), result.payload().toString());
      // Zenoh's own errors, such as a timeout, are no reply of a server.
      if (error.code !== "zenoh") throw error;
    }
    return null;
  }

  async close() {
    await this.token?.undeclare();
    await this.session.close();
  }
}

/**
 * Check that a WebSocket can be opened: zenoh-ts itself tries for ever.
 * @param {string} bridge
 * @returns {Promise<void>}
 */
function answers(bridge) {
  return new Promise((resolve, reject) => {
    const socket = new WebSocket(bridge);
    socket.onopen = () => {
      socket.close();
      resolve();
    };
    socket.onerror = () => reject(new Error(`Nothing answers at ${bridge}: start the bridge.`));
  });
}
