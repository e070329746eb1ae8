/* A stand-in for libusb-1.0: emulated ODrives behind UNIX sockets instead of a USB bus.
 *
 * Every socket (SOCK_SEQPACKET) in the folder XRL_USB is one ODrive v3; the file's name is
 * its serial number. One bulk transfer is one packet. A socket that accepts is a device
 * that is plugged in; one that closes is a device that was pulled out.
 *
 * It has only the functions that libodrive (odrive 0.6.11) calls, with the layouts of
 * libusb 1.0. Everything happens inside libusb_handle_events_timeout, on one file
 * descriptor: an epoll set of the sockets, a timer and a wake-up event. Devices are never
 * freed, because few come and go. System calls dominate the cost, with some hundred
 * exchanges a second in each of six processes, so it avoids every needless call.
 *
 * Like libusb, it releases its lock during callbacks.
 */
#define _GNU_SOURCE
#include <dirent.h>
#include <errno.h>
#include <pthread.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <sys/timerfd.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

enum { IO = -1, INVALID_PARAM = -2, NO_DEVICE = -4, NOT_FOUND = -5, BUSY = -6 };
enum { COMPLETED, FAILED, TIMED_OUT, CANCELLED, STALL, GONE };
enum { ARRIVED = 1, LEFT = 2, ENUMERATE = 1 };
enum { FREE_TRANSFER = 4 };
enum { RESCAN_MS = 50, DEVICES = 256, OUT_ENDPOINT = 0x03, IN_ENDPOINT = 0x83, INTERFACE = 2 };

typedef struct context context;
typedef struct device device;
typedef struct transfer transfer;
typedef void (*transfer_callback)(transfer *);
typedef int (*hotplug_callback)(context *, device *, int event, void *user_data);
typedef struct { device *dev; } handle;

struct transfer { /* struct libusb_transfer */
    handle *dev_handle;
    uint8_t flags;
    unsigned char endpoint, type;
    unsigned int timeout;
    int status, length, actual_length;
    transfer_callback callback;
    void *user_data;
    unsigned char *buffer;
    int num_iso_packets;
};

typedef struct pending { /* hidden in front of every transfer */
    struct pending *next;
    int64_t deadline_ms; /* 0: none */
    int cancelled, done;
    transfer public;
} pending;

struct device {
    char serial[256];
    int fd; /* -1 once pulled out */
    int address, claimed, hung_up, announced_left;
    handle handle;
};

struct context {
    int epoll_fd, timer_fd, wake_fd;
    hotplug_callback hotplug;
    void *hotplug_data;
};

typedef struct {
    uint8_t bLength, bDescriptorType;
    uint16_t bcdUSB;
    uint8_t bDeviceClass, bDeviceSubClass, bDeviceProtocol, bMaxPacketSize0;
    uint16_t idVendor, idProduct, bcdDevice;
    uint8_t iManufacturer, iProduct, iSerialNumber, bNumConfigurations;
} device_descriptor;

typedef struct {
    uint8_t bLength, bDescriptorType, bEndpointAddress, bmAttributes;
    uint16_t wMaxPacketSize;
    uint8_t bInterval, bRefresh, bSynchAddress;
    const unsigned char *extra;
    int extra_length;
} endpoint_descriptor;

typedef struct {
    uint8_t bLength, bDescriptorType, bInterfaceNumber, bAlternateSetting, bNumEndpoints;
    uint8_t bInterfaceClass, bInterfaceSubClass, bInterfaceProtocol, iInterface;
    const endpoint_descriptor *endpoint;
    const unsigned char *extra;
    int extra_length;
} interface_descriptor;

typedef struct {
    const interface_descriptor *altsetting;
    int num_altsetting;
} interface_t;

typedef struct {
    uint8_t bLength, bDescriptorType;
    uint16_t wTotalLength;
    uint8_t bNumInterfaces, bConfigurationValue, iConfiguration, bmAttributes, MaxPower;
    const interface_t *interface;
    const unsigned char *extra;
    int extra_length;
} config_descriptor;

typedef struct {
    int fd;
    short events;
} pollfd_t;

/* The firmware's composite device: two CDC interfaces, then the native (Fibre 0.1) one. */
static const endpoint_descriptor native_endpoints[] = {
    {7, 5, OUT_ENDPOINT, 2, 64, 0, 0, 0, NULL, 0},
    {7, 5, IN_ENDPOINT, 2, 64, 0, 0, 0, NULL, 0},
};
static const interface_descriptor alternates[] = {
    {9, 4, 0, 0, 0, 2, 2, 1, 0, NULL, NULL, 0},
    {9, 4, 1, 0, 0, 10, 0, 0, 0, NULL, NULL, 0},
    {9, 4, INTERFACE, 0, 2, 0, 1, 0, 6, native_endpoints, NULL, 0},
};
static const interface_t interfaces[] = {{alternates, 1}, {alternates + 1, 1}, {alternates + 2, 1}};
static const config_descriptor configuration = {9, 2, 141, 3, 1, 0, 0xC0, 50, interfaces, NULL, 0};

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static context the_context = {-1, -1, -1, NULL, NULL};
static device *devices[DEVICES];
static int n_devices;
static pending *queue; /* submitted transfers, oldest first */
static int64_t armed_ms; /* when the timer fires next */
static int woken;        /* the wake-up event is set and not handled yet */
static int finishing;    /* the event loop checks the whole queue again before it returns */

static int64_t now_ms(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1000LL + t.tv_nsec / 1000000;
}

static pending *of(transfer *t)
{
    return (pending *)((char *)t - offsetof(pending, public));
}

static void wake(void)
{
    uint64_t one = 1;
    if (!woken && !finishing && write(the_context.wake_fd, &one, sizeof one) == sizeof one)
        woken = 1;
}

/* Make the timer fire at ms or earlier. */
static void fire_by(int64_t ms)
{
    if (armed_ms && armed_ms <= ms)
        return;
    armed_ms = ms;
    struct itimerspec at = {.it_value = {ms / 1000, ms % 1000 * 1000000}};
    timerfd_settime(the_context.timer_fd, TFD_TIMER_ABSTIME, &at, NULL);
}

/* Make the timer fire at the next deadline, or for the next scan of the folder. */
static void set_timer(void)
{
    int64_t now = now_ms(), next = now + RESCAN_MS;
    for (pending *p = queue; p; p = p->next)
        if (p->deadline_ms && p->deadline_ms < next)
            next = p->deadline_ms;
    fire_by(next > now ? next : now + 1);
}

static void plug_in(const char *folder, const char *serial)
{
    struct sockaddr_un at = {.sun_family = AF_UNIX};
    for (int i = 0; i < n_devices; i++)
        if (devices[i]->fd >= 0 && !strcmp(devices[i]->serial, serial))
            return;
    if (n_devices == DEVICES ||
        snprintf(at.sun_path, sizeof at.sun_path, "%s/%s", folder, serial) >= (int)sizeof at.sun_path)
        return;
    int fd = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC | SOCK_NONBLOCK, 0);
    if (fd < 0 || connect(fd, (struct sockaddr *)&at, sizeof at) < 0) {
        close(fd);
        return;
    }
    device *d = calloc(1, sizeof *d);
    snprintf(d->serial, sizeof d->serial, "%s", serial);
    d->fd = fd;
    d->address = 1 + n_devices % 120;
    d->handle.dev = d;
    /* edge-triggered: data that arrives before its transfer is read when that is submitted */
    struct epoll_event e = {.events = EPOLLIN | EPOLLET, .data.ptr = d};
    epoll_ctl(the_context.epoll_fd, EPOLL_CTL_ADD, fd, &e);
    devices[n_devices++] = d;
}

static void rescan(void)
{
    const char *folder = getenv("XRL_USB");
    DIR *dir = folder ? opendir(folder) : NULL;
    for (struct dirent *entry; dir && (entry = readdir(dir));)
        if (entry->d_name[0] != '.')
            plug_in(folder, entry->d_name);
    if (dir)
        closedir(dir);
}

static void pull_out(device *d)
{
    if (d->fd >= 0) {
        epoll_ctl(the_context.epoll_fd, EPOLL_CTL_DEL, d->fd, NULL);
        close(d->fd);
        d->fd = -1;
    }
}

/* Return the oldest unfinished transfer at an endpoint of a device. */
static pending *oldest(device *d, unsigned char endpoint)
{
    for (pending *p = queue; p; p = p->next)
        if (p->public.dev_handle->dev == d && p->public.endpoint == endpoint && !p->done)
            return p;
    return NULL;
}

/* Try to finish a transfer; return 1 if it is done, with its status set. Packets go in order, so
 * only the oldest at its endpoint may send or receive. */
static int advance(pending *p)
{
    transfer *t = &p->public;
    device *d = t->dev_handle->dev;
    ssize_t n;
    if (p->done)
        return 1;
    if (p->cancelled) {
        t->status = CANCELLED;
        return 1;
    }
    if (d->fd >= 0 && !t->length) { /* a flush; an empty packet would mean the end of the stream */
        t->status = COMPLETED;
        return 1;
    }
    if (d->fd >= 0 && oldest(d, t->endpoint) == p) {
        if (t->endpoint & 0x80)
            n = recv(d->fd, t->buffer, t->length, MSG_DONTWAIT);
        else
            n = send(d->fd, t->buffer, t->length, MSG_DONTWAIT | MSG_NOSIGNAL);
        if (n > 0) {
            t->actual_length = n;
            t->status = COMPLETED;
            return 1;
        }
        if (n == 0 || (errno != EAGAIN && errno != EWOULDBLOCK))
            pull_out(d);
    }
    if (d->fd < 0) {
        t->status = GONE;
        return 1;
    }
    if (p->deadline_ms && now_ms() >= p->deadline_ms) {
        t->status = TIMED_OUT;
        return 1;
    }
    return 0;
}

static pending *take_finished(void)
{
    for (pending **link = &queue; *link; link = &(*link)->next) {
        pending *p = *link;
        if (advance(p)) {
            *link = p->next;
            return p;
        }
    }
    return NULL;
}

int libusb_init(context **ctx)
{
    the_context.epoll_fd = epoll_create1(EPOLL_CLOEXEC);
    the_context.timer_fd = timerfd_create(CLOCK_MONOTONIC, TFD_CLOEXEC | TFD_NONBLOCK);
    the_context.wake_fd = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
    int own[] = {the_context.timer_fd, the_context.wake_fd};
    for (int i = 0; i < 2; i++) { /* edge-triggered: they need not be read */
        struct epoll_event e = {.events = EPOLLIN | EPOLLET, .data.ptr = NULL};
        epoll_ctl(the_context.epoll_fd, EPOLL_CTL_ADD, own[i], &e);
    }
    *ctx = &the_context;
    rescan();
    set_timer();
    return 0;
}

void libusb_exit(context *ctx)
{
    for (int i = 0; i < n_devices; i++)
        pull_out(devices[i]);
    n_devices = 0;
    close(ctx->timer_fd);
    close(ctx->wake_fd);
    close(ctx->epoll_fd);
    ctx->hotplug = NULL;
    armed_ms = woken = 0;
}

int libusb_handle_events_timeout(context *ctx, struct timeval *timeout)
{
    struct epoll_event ready[32];
    int wait_ms = timeout ? timeout->tv_sec * 1000 + timeout->tv_usec / 1000 : -1;
    int n = epoll_wait(ctx->epoll_fd, ready, 32, wait_ms);
    pthread_mutex_lock(&lock);
    woken = 0;
    for (int i = 0; i < n; i++) {
        device *d = ready[i].data.ptr;
        if (d && ready[i].events & (EPOLLHUP | EPOLLERR))
            d->hung_up = 1;
    }
    finishing = 1;
    for (pending *p; (p = take_finished());) {
        pthread_mutex_unlock(&lock);
        int free_it = p->public.flags & FREE_TRANSFER;
        p->public.callback(&p->public);
        if (free_it)
            free(p);
        pthread_mutex_lock(&lock);
    }
    finishing = 0;
    int before = n_devices;
    if (armed_ms <= now_ms()) {
        armed_ms = 0;
        rescan();
        set_timer();
    }
    for (int i = 0; i < n_devices; i++) {
        device *d = devices[i];
        if (d->hung_up && !oldest(d, IN_ENDPOINT)) /* else that transfer detects it */
            pull_out(d);
        int left = d->fd < 0 && !d->announced_left;
        d->announced_left |= left;
        if (ctx->hotplug && (left || i >= before)) {
            pthread_mutex_unlock(&lock);
            ctx->hotplug(ctx, d, left ? LEFT : ARRIVED, ctx->hotplug_data);
            pthread_mutex_lock(&lock);
        }
    }
    pthread_mutex_unlock(&lock);
    return 0;
}

int libusb_get_next_timeout(context *ctx, struct timeval *timeout)
{
    return 0; /* the timer's descriptor is in the epoll set */
}

int libusb_pollfds_handle_timeouts(context *ctx)
{
    return 1;
}

const pollfd_t **libusb_get_pollfds(context *ctx)
{
    pollfd_t **list = calloc(3, sizeof *list);
    pollfd_t *only = (pollfd_t *)(list + 2);
    only->fd = ctx->epoll_fd;
    only->events = EPOLLIN;
    list[0] = only;
    return (const pollfd_t **)list;
}

void libusb_free_pollfds(const pollfd_t **list)
{
    free((void *)list);
}

void libusb_set_pollfd_notifiers(context *ctx, void *added, void *removed, void *user_data)
{
}

int libusb_has_capability(uint32_t capability)
{
    return capability <= 1; /* the interface itself, and hot-plug */
}

int libusb_hotplug_register_callback(context *ctx, int events, int flags, int vendor, int product,
                                     int class, hotplug_callback callback, void *user_data,
                                     int *callback_handle)
{
    ctx->hotplug_data = user_data;
    ctx->hotplug = callback;
    if (callback_handle)
        *callback_handle = 1;
    for (int i = 0; flags & ENUMERATE && i < n_devices; i++)
        if (devices[i]->fd >= 0)
            callback(ctx, devices[i], ARRIVED, user_data);
    return 0;
}

void libusb_hotplug_deregister_callback(context *ctx, int callback_handle)
{
    ctx->hotplug = NULL;
}

ssize_t libusb_get_device_list(context *ctx, device ***list)
{
    ssize_t n = 0;
    *list = calloc(n_devices + 1, sizeof **list);
    for (int i = 0; i < n_devices; i++)
        if (devices[i]->fd >= 0)
            (*list)[n++] = devices[i];
    return n;
}

void libusb_free_device_list(device **list, int unref)
{
    free(list);
}

device *libusb_ref_device(device *d)
{
    return d;
}

void libusb_unref_device(device *d)
{
}

uint8_t libusb_get_bus_number(device *d)
{
    return 1;
}

uint8_t libusb_get_device_address(device *d)
{
    return d->address;
}

int libusb_get_device_descriptor(device *d, device_descriptor *out)
{
    *out = (device_descriptor){18, 1, 0x0200, 239, 2, 1, 64, 0x1209, 0x0D32, 0x0300, 1, 2, 3, 1};
    return 0;
}

int libusb_get_active_config_descriptor(device *d, config_descriptor **out)
{
    *out = (config_descriptor *)&configuration;
    return 0;
}

void libusb_free_config_descriptor(config_descriptor *c)
{
}

int libusb_open(device *d, handle **out)
{
    if (d->fd < 0)
        return NO_DEVICE;
    *out = &d->handle;
    return 0;
}

void libusb_close(handle *h)
{
    h->dev->claimed = 0;
}

int libusb_claim_interface(handle *h, int number)
{
    if (number != INTERFACE)
        return NOT_FOUND;
    if (h->dev->claimed)
        return BUSY;
    h->dev->claimed = 1;
    return 0;
}

int libusb_release_interface(handle *h, int number)
{
    h->dev->claimed = 0;
    return 0;
}

int libusb_clear_halt(handle *h, unsigned char endpoint)
{
    return h->dev->fd < 0 ? NO_DEVICE : 0;
}

int libusb_get_string_descriptor_ascii(handle *h, uint8_t index, unsigned char *out, int length)
{
    const char *texts[] = {"", "ODrive Robotics", "ODrive 3.6 CDC Interface", h->dev->serial};
    if (index > 3)
        return INVALID_PARAM;
    return snprintf((char *)out, length, "%s", texts[index]);
}

transfer *libusb_alloc_transfer(int iso_packets)
{
    pending *p = calloc(1, sizeof *p);
    return p ? &p->public : NULL;
}

void libusb_free_transfer(transfer *t)
{
    if (t)
        free(of(t));
}

int libusb_submit_transfer(transfer *t)
{
    pending *p = of(t), **end = &queue;
    int result = 0;
    pthread_mutex_lock(&lock);
    if (t->dev_handle->dev->fd < 0) {
        result = NO_DEVICE;
    } else {
        p->next = NULL;
        p->cancelled = p->done = t->actual_length = 0;
        p->deadline_ms = t->timeout ? now_ms() + t->timeout : 0;
        while (*end)
            end = &(*end)->next;
        *end = p;
        /* send or receive at once if possible; the event loop reports it */
        p->done = advance(p);
        if (p->done)
            wake();
        else if (p->deadline_ms)
            fire_by(p->deadline_ms);
    }
    pthread_mutex_unlock(&lock);
    return result;
}

int libusb_cancel_transfer(transfer *t)
{
    int result = NOT_FOUND;
    pthread_mutex_lock(&lock);
    for (pending *p = queue; p; p = p->next)
        if (p == of(t) && !p->done) {
            p->cancelled = 1;
            result = 0;
            wake();
        }
    pthread_mutex_unlock(&lock);
    return result;
}

const char *libusb_error_name(int code)
{
    return code ? "LIBUSB_ERROR" : "LIBUSB_SUCCESS";
}
