/* handmap: a saved hand follows a person's. The library in C, for control loops without Python.
 *
 *     handmap_follower *hand;
 *     if (handmap_load(bytes, size, NULL, &hand) != HANDMAP_OK) puts(handmap_last_error());
 *     handmap_sample sample = handmap_new_sample(time, landmarks);
 *     handmap_command command;
 *     handmap_follow(hand, &sample, &command);    // command.q, in the order of handmap_joint_name
 *     handmap_free(hand);
 *
 * `handmap hands save NAME` writes the bytes. Lengths are in metres, angles in radians, times in seconds.
 * Poses are matrices of 4 by 4 numbers, row by row. Landmarks are 21 points in MediaPipe's order: the
 * wrist, then thumb, index, middle, ring and little finger with four each, from the palm to the tip.
 *
 * No function throws. Each says by its result what went wrong, and `handmap_last_error` says it in words;
 * the hand is then as it was before. One thread at a time works on a hand: another one gets
 * HANDMAP_BUSY. Hands do not disturb each other.
 */
#ifndef HANDMAP_HANDMAP_H
#define HANDMAP_HANDMAP_H

#include <stddef.h>

#if defined(_WIN32)
#define HANDMAP_API
#else
#define HANDMAP_API __attribute__((visibility("default")))
#endif

#ifdef __cplusplus
extern "C" {
#endif

/* What became of a call. */
typedef enum {
  HANDMAP_OK = 0,
  HANDMAP_INVALID_INPUT = 1, /* a sample or an argument that cannot be used */
  HANDMAP_INVALID_HAND = 2,  /* bytes that are no saved hand, or one of another version */
  HANDMAP_BUSY = 3,          /* another thread works on the hand */
  HANDMAP_FAILED = 4         /* out of memory, or a fault of this library */
} handmap_result;

/* How the QP of a command ended. */
typedef enum {
  HANDMAP_CONVERGED = 0,   /* the robot is where the person's hand asks for */
  HANDMAP_LIMITED = 1,     /* a limit of speed or acceleration holds it back */
  HANDMAP_UNREACHABLE = 2, /* it is as near as it can come */
  HANDMAP_UNSETTLED = 3,   /* it is still on its way after the iterations of this sample */
  HANDMAP_NO_SOLUTION = 4, /* the solver failed: the robot brakes */
  HANDMAP_RELEASED = 5     /* the robot is held, or disengaged: it brakes or stands still */
} handmap_status;

/* How the robot comes back to the person after samples that were held. */
typedef enum {
  HANDMAP_GLIDE = 0, /* it glides there */
  HANDMAP_CLUTCH = 1 /* its palm stays where it is, and moves on from there */
} handmap_rejoin;

typedef struct {
  handmap_rejoin rejoin;
  int smooths;         /* whether samples are smoothed by their noise; 0: they are mapped as they are */
  double acceleration; /* that a point at rest may have [m/s^2] */
  double speed_gain;   /* rise of the acceleration with the speed of a point [1/s] */
} handmap_options;

/* A sample of a tracker. */
typedef struct {
  double time;             /* its time stamp [s] */
  const double *landmarks; /* (21, 3) in the tracker's world [m] */
  const double *wrist;     /* pose of the wrist there, (4, 4); NULL: fitted to the palm's landmarks */
  int valid;               /* 0 where the tracker does not see the hand */
  double confidence;       /* of the tracker, 0 to 1 */
  double arrival;          /* when it arrived, on a monotonic clock [s]; NaN: not known */
  double dt;               /* time since the robot's last command [s]; NaN: by the time stamps */
} handmap_sample;

/* A command for the robot. Its arrays belong to the hand, and hold until its next call. */
typedef struct {
  double time;            /* instant of the command, on the robot's clock [s] */
  double wrist[16];       /* pose of the robot's wrist in its world, (4, 4) */
  const double *q;        /* joint positions [rad or m] */
  const double *velocity; /* joint velocities since the command before [rad/s or m/s] */
  size_t joints;          /* number of both */
  int status;             /* a handmap_status */
  int is_held;            /* whether the robot brakes or stands still, instead of following */
  int is_gliding;         /* whether it is on its way back to the person after a hold */
  const char *rule;       /* the rule by which the sample is held or suspected, such as "missing"; or "" */
  const char *mistake;    /* what the input seems to be instead, such as "order" or "length"; or "" */
} handmap_command;

typedef struct handmap_follower handmap_follower;

/* Version of the library; files of other versions are not read. */
HANDMAP_API const char *handmap_version(void);

/* What went wrong in this thread last, in words. */
HANDMAP_API const char *handmap_last_error(void);

/* Word for a handmap_status, such as "limited"; "" for none. */
HANDMAP_API const char *handmap_status_name(int status);

/* Options as they are without any. */
HANDMAP_API handmap_options handmap_default_options(void);

/* A valid sample with landmarks alone, judged by its time stamp. */
HANDMAP_API handmap_sample handmap_new_sample(double time, const double *landmarks);

/* Read the bytes of a saved hand, which are not needed afterwards. `options` may be NULL. */
HANDMAP_API handmap_result handmap_load(const void *bytes, size_t size, const handmap_options *options,
                                        handmap_follower **hand);
HANDMAP_API void handmap_free(handmap_follower *hand);

/* What the hand is. The texts hold as long as it does; NULL for a joint that there is not. */
HANDMAP_API const char *handmap_name(const handmap_follower *hand);
HANDMAP_API const char *handmap_side(const handmap_follower *hand); /* of the person's hand */
HANDMAP_API double handmap_usual_dt(const handmap_follower *hand);  /* between samples [s] */
HANDMAP_API size_t handmap_joint_count(const handmap_follower *hand);
HANDMAP_API const char *handmap_joint_name(const handmap_follower *hand, size_t joint);
/* Limits of the joints: positions [rad or m], and speeds [rad/s or m/s], which may be infinite. Each array
 * has room for all joints. */
HANDMAP_API handmap_result handmap_joint_limits(handmap_follower *hand, double *lower, double *upper,
                                                double *speed);
HANDMAP_API size_t handmap_human_joint_count(const handmap_follower *hand);
HANDMAP_API const char *handmap_human_joint_name(const handmap_follower *hand, size_t joint);

/* The robot's links, and where they are after the last command: poses in its world, (links, 4, 4). */
HANDMAP_API size_t handmap_link_count(const handmap_follower *hand);
HANDMAP_API const char *handmap_link_name(const handmap_follower *hand, size_t link);
HANDMAP_API handmap_result handmap_link_poses(handmap_follower *hand, double *poses);

/* Where the person's landmarks are, (21, 3), for joint angles [rad] and a pose of the wrist (4, 4). A
 * landmark that the hand does not follow is left as it is. */
HANDMAP_API handmap_result handmap_human_landmarks(handmap_follower *hand, const double *human_q,
                                                   const double *wrist, double *landmarks);

/* Follow the next sample of a tracker if it makes sense; else brake, and hold. The first one, and the
 * first one after `handmap_engage`, is the reference that motion is counted from. */
HANDMAP_API handmap_result handmap_follow(handmap_follower *hand, const handmap_sample *sample,
                                          handmap_command *command);

/* Map landmarks (21, 3) as they are: not judged, not smoothed. `wrist` may be NULL. `dt` is the time since
 * the last command [s]. */
HANDMAP_API handmap_result handmap_map_landmarks(handmap_follower *hand, const double *landmarks,
                                                 const double *wrist, double dt,
                                                 handmap_command *command);

/* Map joint angles of the person's hand [rad], in the order of `handmap_human_joint_name`, and the pose of
 * its wrist (4, 4), likewise. */
HANDMAP_API handmap_result handmap_map_joints(handmap_follower *hand, const double *human_q,
                                              const double *wrist, double dt,
                                              handmap_command *command);

/* Brake, and keep the posture, for one command. The next sample is followed again. */
HANDMAP_API handmap_result handmap_hold(handmap_follower *hand, double dt, handmap_command *command);

/* Follow from the next sample on, which becomes the reference: the robot goes on from where it is. */
HANDMAP_API handmap_result handmap_engage(handmap_follower *hand);

/* Brake from the next command on, and hold whatever samples say, until `handmap_engage`. */
HANDMAP_API handmap_result handmap_disengage(handmap_follower *hand);

/* Both at once: disengage, and brake by this command. */
HANDMAP_API handmap_result handmap_stop(handmap_follower *hand, double dt, handmap_command *command);

#ifdef __cplusplus
}
#endif

#endif
