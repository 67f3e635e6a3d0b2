/* An EKF-SLAM in C whose estimates slamgym judges.
 *
 *     slamgym generate six_landmarks --episodes 50 --controller open_loop --format slamlog --out drives
 *     cc -O2 examples/16_judge_a_program_in_c.c -o ekf_slam -lm
 *     mkdir estimates
 *     ./ekf_slam estimates drives/shard_*\/seed_*.csv
 *     slamgym judge estimates --drives drives
 *
 * A drive is a text file with one event a line. The filter takes `measurement` and
 * `odometry` lines and the noise in the header, but not the truth. It writes, for each
 * drive, a file of the same name: a line for the pose of every step, with the 9 entries
 * of its covariance, and a line for each landmark of the final map.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { MOST = 64, SIZE = 3 + 2 * MOST };

static double x[SIZE], P[SIZE][SIZE]; /* (x, y, heading, l1x, l1y, ...), covariance */
static double motion[3], sensor[2];   /* standard deviations */
static int n, place[1024];            /* size of the state; column of each landmark */

static double wrap(double angle) { return atan2(sin(angle), cos(angle)); }

static void start(const double pose[3], const double std[3])
{
    memset(P, 0, sizeof P);
    memset(place, 0, sizeof place);
    n = 3;
    for (int i = 0; i < 3; i++) x[i] = pose[i], P[i][i] = std[i] * std[i];
}

/* Drive d, then turn a: P <- G P G' + F R F'. */
static void predict(double d, double a)
{
    double c = cos(x[2]), s = sin(x[2]);
    double along = motion[0] * motion[0], across = motion[1] * motion[1];
    for (int i = 0; i < n; i++) P[0][i] -= d * s * P[2][i], P[1][i] += d * c * P[2][i];
    for (int i = 0; i < n; i++) P[i][0] -= d * s * P[i][2], P[i][1] += d * c * P[i][2];
    P[0][0] += c * c * along + s * s * across;
    P[1][1] += s * s * along + c * c * across;
    P[0][1] += c * s * (along - across), P[1][0] = P[0][1];
    P[2][2] += motion[2] * motion[2];
    x[0] += d * c, x[1] += d * s, x[2] = wrap(x[2] + a);
}

/* Append the landmark at this bearing and range, correlated with the pose. */
static void add(int id, double bearing, double range)
{
    double c = cos(x[2] + bearing), s = sin(x[2] + bearing);
    double across = range * sensor[0], along = sensor[1];
    int j = place[id] = n;
    x[j] = x[0] + range * c, x[j + 1] = x[1] + range * s;
    n += 2;
    for (int i = 0; i < j; i++) {
        P[j][i] = P[i][j] = P[0][i] - range * s * P[2][i];
        P[j + 1][i] = P[i][j + 1] = P[1][i] + range * c * P[2][i];
    }
    for (int k = 0; k < 2; k++) {
        P[j][j + k] = P[0][j + k] - range * s * P[2][j + k];
        P[j + 1][j + k] = P[1][j + k] + range * c * P[2][j + k];
    }
    P[j][j] += c * c * along * along + s * s * across * across;
    P[j + 1][j + 1] += s * s * along * along + c * c * across * across;
    P[j][j + 1] += c * s * (along * along - across * across);
    P[j + 1][j] = P[j][j + 1];
}

/* Correct with one reading: K = P H' S^-1, P <- P - K S K'. */
static void correct(int id, double bearing, double range)
{
    int j = place[id], column[5] = {0, 1, 2, j, j + 1};
    double dx = x[j] - x[0], dy = x[j + 1] - x[1], q = dx * dx + dy * dy, r = sqrt(q);
    double H[2][5] = {{dy / q, -dx / q, -1, -dy / q, dx / q},
                      {-dx / r, -dy / r, 0, dx / r, dy / r}};
    double nu[2] = {wrap(bearing - atan2(dy, dx) + x[2]), range - r};
    double PH[SIZE][2] = {{0}}, S[2][2] = {{sensor[0] * sensor[0], 0},
                                           {0, sensor[1] * sensor[1]}};
    for (int i = 0; i < n; i++)
        for (int k = 0; k < 5; k++)
            for (int m = 0; m < 2; m++) PH[i][m] += P[i][column[k]] * H[m][k];
    for (int k = 0; k < 5; k++)
        for (int l = 0; l < 2; l++)
            for (int m = 0; m < 2; m++) S[l][m] += H[l][k] * PH[column[k]][m];
    double det = S[0][0] * S[1][1] - S[0][1] * S[1][0];
    static double K[SIZE][2];
    for (int i = 0; i < n; i++) {
        K[i][0] = (PH[i][0] * S[1][1] - PH[i][1] * S[1][0]) / det;
        K[i][1] = (PH[i][1] * S[0][0] - PH[i][0] * S[0][1]) / det;
    }
    for (int i = 0; i < n; i++) {
        x[i] += K[i][0] * nu[0] + K[i][1] * nu[1];
        for (int k = 0; k <= i; k++) /* symmetric in spite of rounding */
            P[k][i] = P[i][k] -= K[i][0] * PH[k][0] + K[i][1] * PH[k][1];
    }
    x[2] = wrap(x[2]);
}

static void write_pose(FILE *out, double t)
{
    fprintf(out, "pose,%g,%.17g,%.17g,%.17g", t, x[0], x[1], x[2]);
    for (int i = 0; i < 9; i++) fprintf(out, ",%.17g", P[i / 3][i % 3]);
    fprintf(out, "\n");
}

static void filter(FILE *in, FILE *out)
{
    char line[256];
    double t = 0, d, a, dt, bearing, range, pose[3], std[3];
    int id, begun = 0;
    while (fgets(line, sizeof line, in)) {
        sscanf(line, "# start: %lf,%lf,%lf", &pose[0], &pose[1], &pose[2]);
        sscanf(line, "# start_sigma: %lf,%lf,%lf", &std[0], &std[1], &std[2]);
        sscanf(line, "# motion_std: %lf,%lf,%lf", &motion[0], &motion[1], &motion[2]);
        sscanf(line, "# measurement_std: %lf,%lf", &sensor[0], &sensor[1]);
        if (!begun && line[0] != '#') start(pose, std), begun = 1;
        if (!strncmp(line, "odometry", 8)) {
            write_pose(out, t); /* all readings of the step before it are in */
            sscanf(line, "odometry,%lf,%lf,%lf,%lf", &t, &d, &a, &dt);
            predict(d, a);
        } else if (sscanf(line, "measurement,%*f,%d,%lf,%lf", &id, &bearing, &range) == 3) {
            if (place[id]) correct(id, bearing, range);
            else add(id, bearing, range);
        }
    }
    write_pose(out, t);
    for (id = 0; id < 1024; id++) {
        int j = place[id];
        if (j) fprintf(out, "landmark,%d,%.17g,%.17g,%.17g,%.17g,%.17g\n", id, x[j],
                       x[j + 1], P[j][j], P[j][j + 1], P[j + 1][j + 1]);
    }
}

int main(int count, char **names)
{
    for (int k = 2; k < count; k++) {
        char path[4096], *name = strrchr(names[k], '/');
        snprintf(path, sizeof path, "%s/%s", names[1], name ? name + 1 : names[k]);
        FILE *in = fopen(names[k], "r"), *out = fopen(path, "w");
        if (!in || !out) return perror(in ? path : names[k]), 1;
        filter(in, out);
        fclose(in), fclose(out);
    }
    return 0;
}
