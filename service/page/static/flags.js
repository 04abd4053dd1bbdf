// What each flag of an estimate means to a person, and how grave it is.

const ABOUT = {
  untrained: ["bad", "the model is not trained; its numbers have no meaning"],
  uncalibrated: ["soft", "no CameraInfo; the sensor is scaled onto the canonical camera"],
  unscaled: ["soft", "no camera height; the linear part assumes 1 m"],
  settling: ["", "the recurrent state is young"],
  reset: ["bad", "the recurrent state was reset in this window"],
  sensor_changed: ["bad", "the geometry of the sensor or its CameraInfo changed"],
  gap: ["bad", "packets of this window are missing"],
  overload: ["bad", "the node dropped data because it cannot keep up"],
  late: ["", "published long after the end of the window"],
  low_activity: ["", "fewer events than the model needs to see motion"],
  saturated: ["", "the event count of a cell reached its maximum"],
  frozen: ["bad", "the camera repeats the same events"],
  gyro_disagrees: ["bad", "gyroscope and events turn differently; the gyroscope is not used"],
  uncertain: ["", "the uncertainty is above its bound"],
};

export const about = (flag) => ABOUT[flag]?.[1] ?? "a flag that this page does not know";

export const gravity = (flag) => ABOUT[flag]?.[0] ?? "";
