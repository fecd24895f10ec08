/** Numbers in a row, such as 63 coordinates of 21 landmarks, or the 16 numbers of a pose, row by row. */
export type Numbers = ArrayLike<number>;

export interface Options {
  /** How the robot comes back to the person after samples that were held; `glide` if omitted. */
  rejoin?: "glide" | "clutch";
  /** How samples are smoothed by their noise; `null` for not at all. */
  smoothing?: { acceleration: number; speedGain: number } | null;
}

/** A sample of a tracker. */
export interface Sample {
  /** Its time stamp [s]. */
  time: number;
  /** 21 landmarks in MediaPipe's order, in the tracker's world [m], 63 numbers. */
  landmarks: Numbers;
  /** Pose of the wrist there, 16 numbers; fitted to the landmarks of the palm if omitted. */
  wrist?: Numbers | null;
  /** Whether the tracker sees the hand; true if omitted. */
  valid?: boolean;
  /** Of the tracker, 0 to 1; 1 if omitted. */
  confidence?: number;
  /** When it arrived, on a monotonic clock [s]; not known if omitted. */
  arrival?: number;
  /** Time since the robot's last command [s]; by the time stamps if omitted. */
  dt?: number;
}

export interface Command {
  /** Instant of the command, on the robot's clock [s]. */
  time: number;
  /** Joint positions, in the order of `jointNames` [rad or m]. */
  q: Float64Array;
  /** Joint velocities since the command before [rad/s or m/s]. */
  velocity: Float64Array;
  /** Pose of the robot's wrist in its world, 16 numbers. */
  wrist: Float64Array;
  /** How the QP ended: `converged`, `limited`, `unreachable`, `unsettled`, `failed` or `released`. */
  status: string;
  /** Whether the robot brakes or stands still, instead of following. */
  isHeld: boolean;
  /** Whether it is on its way back to the person after a hold. */
  isGliding: boolean;
  /** The rule by which the sample is held or suspected, such as `missing`; empty for none. */
  rule: string;
  /** What the input seems to be instead, such as `order` or `length`; empty for nothing. */
  mistake: string;
}

/** What went wrong; the hand is then as it was before. */
export class HandmapError extends Error {
  /** `input`: a sample or an argument. `hand`: bytes that are no saved hand. `failed`: anything else. */
  readonly kind: "input" | "hand" | "failed";
}

/** The compiled library. */
export class Library {
  /** Version of the library; hands of other versions are not read. */
  readonly version: string;
  /** Make a hand of the bytes that `handmap hands save` writes. Call its `free` when it is not needed. */
  loadHand(bytes: ArrayBuffer | Uint8Array, options?: Options): Hand;
}

/** Compile `handmap.wasm`: its bytes, the answer to a request for it, or its address. */
export function loadLibrary(
  source: ArrayBuffer | Uint8Array | Response | Promise<Response> | URL | string,
): Promise<Library>;

/** A robot hand that follows a person's. */
export class Hand {
  /** Short name of the robot hand. */
  readonly name: string;
  /** Side of the person's hand that it follows. */
  readonly side: "left" | "right";
  /** Usual time between samples [s]. */
  readonly dt: number;
  readonly jointNames: string[];
  /** The person's joints, in the order of their angles. */
  readonly humanJointNames: string[];
  readonly linkNames: string[];
  /** Follow the next sample if it makes sense; else hold. The first one is the reference. */
  follow(sample: Sample): Command;
  /** Map landmarks as they are: not judged, not smoothed. `dt` is the time since the last command [s]. */
  mapLandmarks(landmarks: Numbers, dt: number, wrist?: Numbers | null): Command;
  /** Map joint angles of the person [rad] and the pose of the wrist, likewise. */
  mapJoints(humanQ: Numbers, wrist: Numbers, dt: number): Command;
  /** Brake, and keep the posture, for one command. */
  hold(dt: number): Command;
  /** Follow from the next sample on, which becomes the reference. */
  engage(): void;
  /** Brake from the next command on, whatever samples say, until `engage`. */
  disengage(): void;
  /** Both at once: disengage, and brake by this command. */
  stop(dt: number): Command;
  /** Limits of the joints: positions [rad or m], and speeds [rad/s or m/s], which may be infinite. */
  jointLimits(): { lower: Float64Array; upper: Float64Array; speed: Float64Array };
  /** Poses of the robot's links in its world after the last command, 16 numbers each. */
  linkPoses(): Float64Array;
  /** Where the person's 21 landmarks are for joint angles [rad] and a pose of the wrist, 63 numbers. */
  humanLandmarks(humanQ: Numbers, wrist: Numbers): Float64Array;
  /** Give the memory of the hand back. */
  free(): void;
}
